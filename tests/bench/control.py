"""Measures XML-RPC calls through the proxy, and the same calls without the proxy.

Each measurement uses a single kept connection, as rospy does for calls to the master. There are two
proxies, each with a rospy node: with uvloop if installed, and with Python's own event loop. If
installed, HAProxy forwards the same HTTP without reading the calls.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from http.client import HTTPConnection
from importlib.util import find_spec
from statistics import median
from time import perf_counter
from typing import Any
from urllib.parse import urlsplit
from xmlrpc.client import dumps, loads

from tests.bench.book import DIRECT, Book
from tests.bench.world import GATEWAY, HOST, INSIDE, MASTER, MASTER_PORT, OUTSIDE, World, world

CALL_SECONDS = 0.5
QUICK_SECONDS = 0.1
WARM_UP_CALLS = 20
TOPICS = 100
PARAMETERS = 1000
"""Parameters that roslaunch sets in a single multicall."""
LAUNCH = f"{PARAMETERS} setParam in one multicall"
NODES = 100
"""Nodes that start at the same time. Each node publishes ten topics."""
FIRST_SLAVE = 50000
ENDING_TOPICS = 10
"""Topics that the ending node publishes, and topics that the node subscribes to.

rospy unregisters all of these in a single multicall.
"""
STRING = "std_msgs/String"
LOOPS = {"uvloop": 0, "asyncio": 1}
"""The event loops, with a number for the ports of the proxy on each loop."""
HAPROXY_PORT = 47000
_HAPROXY = """
global
  maxconn 4096
  nbthread 1
defaults
  mode http
  timeout connect 10s
  timeout client 1h
  timeout server 1h
listen to-master
  bind {gateway}:{port}
  server master {master}
listen to-node
  bind {host}:{port}
  server node {node}
"""
NODE = """
import rospy, std_msgs.msg, sys
rospy.init_node(sys.argv[1])
topic = rospy.Publisher("/stream", std_msgs.msg.String, queue_size=1)
print("uri", rospy.get_node_uri(), flush=True)
rospy.spin()
"""

Where = tuple[str, int]


@dataclass(frozen=True)
class Way:
    """A way for calls; ``path`` is the column in the book.

    Inside calls ``master`` as the node ``name`` with the slave URI ``uri``. Outside calls ``node``.
    """

    path: str
    master: Where
    node: Where
    name: str
    uri: str


class Line:
    """A kept connection. ``times``: the durations of the timed calls in seconds."""

    def __init__(self, address: Where) -> None:
        self.times: list[float] = []
        self._http = HTTPConnection(*address, timeout=10)
        self._http.connect()
        self._sock = self._http.sock

    def close(self) -> None:
        self._http.close()

    def call(self, method: str, *params: Any, timed: bool = True) -> Any:
        """Make a call and return the value. The time does not include writing and reading XML."""
        body = dumps(params, method).encode()
        started = perf_counter()
        self._http.request("POST", "/", body, {"Content-Type": "text/xml"})
        reply = self._http.getresponse().read()
        if timed:
            self.times.append(perf_counter() - started)
        assert self._http.sock is self._sock, "the peer did not keep the connection"
        return loads(reply)[0][0]


def run(book: Book, rounds: int, quick: bool) -> None:
    """Add rates and medians of all calls to the book. The ways take turns in each round."""
    seconds = QUICK_SECONDS if quick else CALL_SECONDS
    with world() as machines, machines.master(), ExitStack() as stack:
        loops = [name for name in LOOPS if name == "asyncio" or find_spec(name)]
        proxied = [stack.enter_context(proxy(machines, loop)) for loop in loops]
        node = host_and_port(proxied[0].uri)
        ways = [Way(DIRECT, (OUTSIDE, MASTER_PORT), node, "/bench_direct", f"http://{OUTSIDE}:9/")]
        if shutil.which("haproxy"):
            ways.append(stack.enter_context(haproxy(machines, node)))
        else:
            book.note("haproxy is not installed and was not compared")
        ways += proxied
        for _ in range(rounds):
            for method, step in CALLS.items():
                compare(book, machines, ways, method, step, seconds)
            for way in ways:
                book.add(
                    f"{NODES} nodes start at once, s", way.path, started_at_once(machines, way)
                )


Step = Callable[[Way, Line, int], None]
"""Makes the n-th timed call of a measurement, and the untimed calls before the timed call."""


def compare(
    book: Book, machines: World, ways: list[Way], method: str, step: Step, seconds: float
) -> None:
    """Measure a call on all ways in a round. The first way is DIRECT."""
    direct = 0.0
    for way in ways:
        times = timed(machines, way, method, step, seconds)
        middle = median(times) * 1e6
        direct = direct or middle
        book.add(f"{method}, 1/s", way.path, len(times) / sum(times))
        book.add(f"{method} p50, us", way.path, middle)
        if way.path != DIRECT:
            book.add(f"{method} p50 added, us", way.path, middle - direct)


def timed(machines: World, way: Way, method: str, step: Step, seconds: float) -> list[float]:
    """The seconds of each call, without the calls of the warm-up."""
    from_outside = method == "requestTopic"
    with machines.entered("outside" if from_outside else "inside"):
        line = Line(way.node if from_outside else way.master)
    warm_up = 1 if method == LAUNCH else WARM_UP_CALLS
    end = perf_counter() + seconds
    while perf_counter() < end or len(line.times) <= 2 * warm_up:
        step(way, line, len(line.times))
    line.close()
    return line.times[warm_up:]


def register(way: Way, line: Line, number: int) -> None:
    topic = f"/bench{way.name}/{number % TOPICS}"
    reply = line.call("registerPublisher", way.name, topic, STRING, way.uri)
    assert reply[0] == 1, reply


def look_up(way: Way, line: Line, _: int) -> None:
    reply = line.call("lookupNode", way.name, way.name)
    assert reply[::2] == [1, way.uri], reply


def request_topic(way: Way, line: Line, _: int) -> None:
    reply = line.call("requestTopic", "/bench_outside", "/stream", [["TCPROS"]])
    assert reply[2][0] == "TCPROS", reply


def end_node(way: Way, line: Line, _: int) -> None:
    """Register a node, then end the node as rospy does (rospy/impl/registration.py)."""
    topics = [f"/bench_ending{way.name}/{number}" for number in range(ENDING_TOPICS)]
    made = [["registerPublisher", topic, STRING] for topic in topics]
    made += [["registerSubscriber", f"{topic}/sub", STRING] for topic in topics]
    line.call("system.multicall", elements(way, made), timed=False)
    ended = [[method.replace("register", "unregister"), topic] for method, topic, _ in made]
    replies = line.call("system.multicall", elements(way, ended))
    assert [reply[0][::2] for reply in replies] == [[1, 1]] * len(ended), replies


def set_parameter(way: Way, line: Line, number: int) -> None:
    reply = line.call("setParam", way.name, f"/bench{way.name}/{number % TOPICS}", number)
    assert reply[0] == 1, reply


def get_parameter(way: Way, line: Line, _: int) -> None:
    reply = line.call("getParam", way.name, f"/bench{way.name}/0")
    assert reply[0] == 1, reply


def launch(way: Way, line: Line, number: int) -> None:
    """Set all parameters of a launch file, as roslaunch does (roslaunch/launch.py)."""
    names = [f"/bench_launched{way.name}/{index}" for index in range(PARAMETERS)]
    calls = [{"methodName": "setParam", "params": [way.name, name, number]} for name in names]
    replies = line.call("system.multicall", calls)
    assert [reply[0][0] for reply in replies] == [1] * PARAMETERS


def started_at_once(machines: World, way: Way) -> float:
    """Seconds until NODES nodes that start at the same time have registered."""
    master = "http://{}:{}/".format(*way.master)
    name = f"crowd_{way.name[1:]}"
    numbers = map(str, (FIRST_SLAVE, NODES, NODES))
    argv = [sys.executable, "-m", "tests.bench.crowd", master, INSIDE, *numbers, name]
    with machines.running("inside", *argv) as process:
        return float(process.wait_for(r"^registered (\S+)", timeout=60)[1])


def elements(way: Way, calls: list[list[str]]) -> list[dict[str, Any]]:
    return [
        {"methodName": method, "params": [way.name, *params, way.uri]} for method, *params in calls
    ]


CALLS: dict[str, Step] = {
    "setParam": set_parameter,
    "getParam": get_parameter,
    LAUNCH: launch,
    "registerPublisher": register,
    "lookupNode": look_up,
    "system.multicall": end_node,
    "requestTopic": request_topic,
}


@contextmanager
def haproxy(machines: World, node: Where) -> Iterator[Way]:
    """Run HAProxy in HTTP mode before the master and before a node."""
    file = machines.folder / "haproxy-http.conf"
    values = {"gateway": GATEWAY, "host": HOST, "port": HAPROXY_PORT}
    targets = {"master": f"{OUTSIDE}:{MASTER_PORT}", "node": "{}:{}".format(*node)}
    file.write_text(_HAPROXY.format(**values, **targets))
    with machines.running("host", "haproxy", "-db", "-f", str(file)) as process:
        machines.wait_listening(process, HOST, HAPROXY_PORT)
        ends = (GATEWAY, HAPROXY_PORT), (HOST, HAPROXY_PORT)
        yield Way("haproxy, HTTP", *ends, "/bench_haproxy", f"http://{OUTSIDE}:9/")


@contextmanager
def proxy(machines: World, loop: str) -> Iterator[Way]:
    """Run a proxy on an event loop, with a rospy node behind the proxy."""
    shift = 1000 * LOOPS[loop]
    name = f"/bench_{loop}"
    port = MASTER_PORT + shift
    argv = [sys.executable, "-m", "rosproxy", "run", "--master-uri", MASTER, "--advertise-host"]
    argv += [HOST, "--port-range", f"{45000 + shift}-{45249 + shift}", "--log-level", "info"]
    argv += ["--master-port", str(port), "--admin-bind", f"127.0.0.1:{port + 1}"]
    ros = machines.ros_environment("inside") | {"ROS_MASTER_URI": f"http://{GATEWAY}:{port}/"}
    node = "/usr/bin/python3", "-c", NODE, f"__name:={name[1:]}", name[1:]
    with machines.running("host", *argv, env=environment(machines, loop)) as process:
        process.wait_for("listening: ", timeout=60)
        with machines.running("inside", *node, env=ros) as rospy:
            uri = rospy.wait_for(r"^uri (\S+)", timeout=30)[1]
            process.wait_for(rf"{name} at \S+ is advertised as http://{HOST}:(\d+)/")
            with machines.entered("outside"):
                line = Line((OUTSIDE, MASTER_PORT))
            lease = host_and_port(line.call("lookupNode", name, name)[2])
            line.close()
            yield Way(f"rosproxy, {loop}", (GATEWAY, port), lease, name, uri)


def environment(machines: World, loop: str) -> dict[str, str]:
    """The environment that makes a proxy use an event loop.

    A proxy uses uvloop if the import works. So for asyncio, a file makes the import fail.
    """
    env = machines.environment("host")
    if loop == "uvloop":
        return env
    folder = machines.folder / "without-uvloop"
    folder.mkdir(exist_ok=True)
    (folder / "uvloop.py").write_text("raise ImportError\n")
    return env | {"PYTHONPATH": os.pathsep.join([str(folder), env["PYTHONPATH"]])}


def host_and_port(uri: str) -> Where:
    parts = urlsplit(uri)
    assert parts.hostname
    assert parts.port
    return parts.hostname, parts.port
