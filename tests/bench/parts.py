"""The processes of the benchmark; each ends with its context."""

import json
import os
import socket
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from subprocess import PIPE, Popen
from typing import Any, NamedTuple

from rosproxy.demo.boundary import Boundary
from rosproxy.demo.rpc import ask
from rosproxy.demo.wire import receive_header
from tests.bench.node import NAME
from tests.integration.net import HOST, MASTER, OUTSIDE, PROXY, Where, free_ports
from tests.integration.node import topic_header
from tests.integration.process import clean_environment, command_line
from tests.integration.proxy import options_for

ROSMASTER = "/usr/bin/rosmaster"
SOCAT = "socat -lf /dev/null -b 131072"  # its own 8 KiB would show it at its worst
# As users run it; the proxies of the tests are less patient.
PATIENCE = {"probe_interval": 5, "probe_timeout": 3, "linger": 30, "master_interval": 2}


class Proxied(NamedTuple):
    """A proxy and a node behind it: where the node is, and where outside is told that it is."""

    pid: int
    master: Where
    node_uri: str
    direct: Where
    lease: Where


@contextmanager
def child(*command: str, **more: str) -> Iterator[Any]:
    """A process, in a session of its own: Ctrl-C is for us to handle."""
    env = clean_environment(**more)
    with Popen(command, stdin=PIPE, stdout=PIPE, env=env, start_new_session=True) as process:
        try:
            yield process
        finally:
            process.kill()


@contextmanager
def master() -> Iterator[str]:
    """The URI of a master: ROS's own where it is installed, else the embedded one."""
    if os.path.exists(ROSMASTER):
        port = free_ports(1)
        with tempfile.TemporaryDirectory() as logs:
            path = f"/usr/bin:{os.environ['PATH']}"  # it needs the system's Python
            env = {"PATH": path, "ROS_IP": MASTER, "ROS_LOG_DIR": logs}
            with child(ROSMASTER, "--core", "-p", str(port), **env):
                yield f"http://{MASTER}:{port}/"
    else:
        boundary = '{"wall": [], "accept_from": [], "leave_from": []}'
        config = f'{{"role": "master", "address": "{MASTER}", "boundary": {boundary}}}'
        with child(sys.executable, "-m", "rosproxy.demo.worker", config) as process:
            yield json.loads(process.stdout.readline())["state"]["uri"]


@contextmanager
def proxied(master_uri: str) -> Iterator[Proxied]:
    """A new proxy, and a new node that has registered through it."""
    options = options_for(master_uri=master_uri, log_level="error", **PATIENCE)
    address = PROXY, int(options["master_port"])
    node = sys.executable, "-m", "tests.bench.node", "http://{}:{}/".format(*address)
    with child(*command_line(options)) as proxy, child(*node) as process:
        uri = process.stdout.readline().decode().strip()
        lease_uri = ask(Boundary(), master_uri, "lookupNode", "/bench", NAME)
        yield Proxied(proxy.pid, address, uri, tcpros_address(uri), tcpros_address(lease_uri))


def tcpros_address(uri: str) -> Where:
    """What a subscriber asks a node before it connects."""
    args = "/bench", "/stream", [["TCPROS"]]
    _, host, port = ask(Boundary(), uri, "requestTopic", *args)
    return host, port


@contextmanager
def socat(target: Where) -> Iterator[tuple[Where, int]]:
    """Where socat listens, soon, and its process."""
    here = HOST, free_ports(1)
    listen = "TCP-LISTEN:{1},bind={0},fork,nodelay".format(*here)
    with child(*SOCAT.split(), listen, "TCP:{}:{},nodelay".format(*target)) as process:
        yield here, process.pid


def subscribe(address: Where, topic: str) -> socket.socket:
    """A TCPROS connection from outside, headers exchanged."""
    sock = socket.create_connection(address, 10, (OUTSIDE, 0))
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.sendall(topic_header(topic))
    assert receive_header(sock)["topic"] == topic
    sock.settimeout(None)
    return sock
