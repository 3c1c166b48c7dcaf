"""The processes of the benchmark; each ends with its context."""

import json
import os
import shutil
import socket
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from subprocess import PIPE, Popen
from types import SimpleNamespace
from typing import Any

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
    if not os.path.exists(ROSMASTER):
        config = {"role": "master", "address": MASTER, "boundary": asdict(Boundary())}
        with child(sys.executable, "-m", "rosproxy.demo.worker", json.dumps(config)) as process:
            yield json.loads(process.stdout.readline())["state"]["uri"]
        return
    port, path = free_ports(1), f"/usr/bin:{os.environ['PATH']}"  # it needs the system's Python
    with tempfile.TemporaryDirectory() as logs:
        env = {"PATH": path, "ROS_IP": MASTER, "ROS_LOG_DIR": logs}
        with child(ROSMASTER, "--core", "-p", str(port), **env):
            yield f"http://{MASTER}:{port}/"


@contextmanager
def proxied(master_uri: str) -> Iterator[SimpleNamespace]:
    """A new proxy, and a new node that has registered through it.

    ``pid`` and ``master`` are the proxy's; ``direct`` is where the node is, ``lease`` where
    outside is told that it is.
    """
    options = options_for(master_uri=master_uri, log_level="error", **PATIENCE)
    address = PROXY, int(options["master_port"])
    node = sys.executable, "-m", "tests.bench.node", "http://{}:{}/".format(*address)
    with child(*command_line(options)) as proxy, child(*node) as process:
        made = SimpleNamespace(pid=proxy.pid, master=address)
        made.node_uri = process.stdout.readline().decode().strip()
        made.direct = tcpros_address(made.node_uri)
        made.lease = tcpros_address(ask(Boundary(), master_uri, "lookupNode", "/bench", NAME))
        yield made


def tcpros_address(uri: str) -> Where:
    """What a subscriber asks a node before it connects."""
    _, host, port = ask(Boundary(), uri, "requestTopic", "/bench", "/stream", [["TCPROS"]])
    return host, port


@contextmanager
def socat(target: Where) -> Iterator[tuple[Where, int] | None]:
    """Where socat listens before its turn comes, and its process; None if there is no socat."""
    if not shutil.which("socat"):
        yield None
        return
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
