"""The ways from outside to a node inside: directly, through rosproxy, through other relays.

And the way from inside to a node outside, through rosproxy with ``--direction both``, where the
node's bytes go *inwards*.

The ways through the kernel have separate worlds, so that the rules cost the other ways nothing.
Each relay has its best configuration: large buffers, and splicing if possible.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, NamedTuple
from urllib.parse import urlsplit
from xmlrpc.client import ServerProxy

from tests.bench.book import DIRECT, Book
from tests.bench.compiled import compiled
from tests.bench.node import NAME, NO_MASTER
from tests.bench.world import ADDRESSES, HOST, MASTER, World, world

PORT = 46000
"""Ports of the other relays on the host, outside of rosproxy's default range."""
BY_HAND = "nft by hand"
KERNEL = "rosproxy kernel"
SPLICE = "rosproxy splice"
COPY = "rosproxy copy"
PLANES = {KERNEL: "kernel", SPLICE: "splice", COPY: "copy"}
INWARDS = {"rosproxy kernel, inwards": "kernel", "rosproxy splice, inwards": "splice"}
PEERS = ("socat", "haproxy", "nginx")
_RULES = """
table ip by-hand {{
  chain coming {{
    type nat hook prerouting priority dstnat
    ip daddr {host} tcp dport {port} dnat to {target}
  }}
  chain leaving {{
    type nat hook postrouting priority srcnat
    ct status dnat masquerade
  }}
}}
"""
# The default of 8 KiB would be unfair.
_SOCAT = ("socat", "-lf", "/dev/null", "-b", "131072")
_HAPROXY = """
global
  maxconn 4096
  tune.bufsize 131072
  tune.pipesize 1048576
defaults
  mode tcp
  option splice-auto
  timeout connect 10s
  timeout client 1h
  timeout server 1h
listen relay
  bind {host}:{port}
  server node {target}
"""
_NGINX = """
load_module /usr/lib/nginx/modules/ngx_stream_module.so;
user root;
daemon off;
worker_processes auto;
pid {folder}/nginx.pid;
error_log {folder}/nginx.log;
events {{ worker_connections 4096; }}
stream {{
  server {{
    listen {host}:{port} backlog=4096;
    proxy_pass {target};
    proxy_timeout 1h;
    proxy_buffer_size 128k;
    tcp_nodelay on;
  }}
}}
"""


class Way(NamedTuple):
    """The address to connect to for the node, and perhaps the process in between.

    ``end`` is the machine that connects.
    """

    name: str
    world: World
    address: tuple[str, int]
    pid: int | None = None
    end: str = "outside"


@contextmanager
def all_ways(book: Book, only: tuple[str, ...] = ()) -> Iterator[list[Way]]:
    """Every way that there is, or ``only`` these; the book is told what is missing."""
    wanted = only or (DIRECT, BY_HAND, *PLANES, *INWARDS, *PEERS)
    with ExitStack() as stack:
        plain = stack.enter_context(world(apart=True))
        target = stack.enter_context(node(plain, NO_MASTER))
        ways = [Way(DIRECT, plain, target)]
        if BY_HAND in wanted:
            ways.append(stack.enter_context(by_hand()))
        ways += [stack.enter_context(proxied(name)) for name in PLANES if name in wanted]
        ways += [stack.enter_context(proxied_inwards(name)) for name in INWARDS if name in wanted]
        for offset, name in enumerate(PEERS):
            if name in wanted and shutil.which(name):
                ways.append(stack.enter_context(peer(plain, name, PORT + offset, target)))
        _note_missing(book, wanted, ways)
        yield [way for way in ways if way.name in wanted]


def _note_missing(book: Book, wanted: tuple[str, ...], ways: list[Way]) -> None:
    for name in wanted:
        if name not in {way.name for way in ways}:
            book.note(f"{name} is not installed and was not compared")


@contextmanager
def node(place: World, master: str, role: str = "inside") -> Iterator[tuple[str, int]]:
    """Run a registered node on a machine. Yields the address of the TCPROS server."""
    wire = str(compiled("wire"))
    address = ADDRESSES[role]
    argv = (sys.executable, "-m", "tests.bench.node", master, wire, address)
    with place.running(role, *argv) as process:
        port = int(process.wait_for(r"^port (\d+)")[1])
        yield address, port


@contextmanager
def by_hand() -> Iterator[Way]:
    """Rules for nftables that a user can write with the node's address and port."""
    with world(apart=True) as place, node(place, NO_MASTER) as (address, port):
        rules = _RULES.format(host=HOST, port=PORT, target=f"{address}:{port}")
        place.run("host", "nft", "-f", "-", text=rules)
        yield Way(BY_HAND, place, (HOST, PORT))


@contextmanager
def proxied(name: str) -> Iterator[Way]:
    """The proxy with a data plane, and a node that registered through the proxy."""
    with (
        world(apart=True) as place,
        place.master(),
        place.proxy(PLANES[name]) as proxy,
        node(place, proxy.master),
    ):
        address = tcpros_address(place, NAME, "/stream", must_be_fast=name == KERNEL)
        yield Way(name, place, address, proxy.pid)


@contextmanager
def proxied_inwards(name: str) -> Iterator[Way]:
    """The proxy with a data plane, and a node outside with a subscriber inside."""
    plane = INWARDS[name]
    with (
        world(apart=True) as place,
        place.master(),
        place.proxy(plane, "--direction", "both", "--inside-network", "172.31.0.0/24") as proxy,
        node(place, MASTER, "outside"),
    ):
        address = tcpros_address(place, NAME, "/stream", plane == "kernel", "inside", proxy.master)
        yield Way(name, place, address, proxy.pid, "inside")


def tcpros_address(
    place: World,
    node_name: str,
    topic: str,
    must_be_fast: bool,
    end: str = "outside",
    master: str = MASTER,
) -> tuple[str, int]:
    """The TCPROS address that a subscriber on a machine gets from the node, by the master.

    Raises RuntimeError if the kernel should forward, but the port is the proxy's.
    """
    with place.entered(end):
        uri = call(master, "lookupNode", node_name)
        _, host, port = call(uri, "requestTopic", topic, [["TCPROS"]])
    if must_be_fast and port == urlsplit(uri).port:
        raise RuntimeError("the kernel does not forward: see `rosproxy status` for the reason")
    return host, port


def call(uri: str, method: str, *arguments: Any) -> Any:
    """The value of a reply. Raises RuntimeError with the text of a failure."""
    with ServerProxy(uri) as server:
        reply: Any = getattr(server, method)("/bench", *arguments)
    if reply[0] != 1:
        raise RuntimeError(f"{method}{arguments} at {uri}: {reply[1]}")
    return reply[2]


@contextmanager
def peer(place: World, name: str, port: int, target: tuple[str, int]) -> Iterator[Way]:
    """Run a relay that knows nothing of ROS, and yield its way once it listens."""
    with place.running("host", *peer_command(place, name, port, target)) as process:
        place.wait_listening(process, HOST, port)
        yield Way(name, place, (HOST, port), process.pid)


def peer_command(place: World, name: str, port: int, target: tuple[str, int]) -> list[str]:
    """The command line of a relay, with its configuration written into the world's folder."""
    values = {"host": HOST, "port": port, "target": "{}:{}".format(*target)}
    if name == "socat":
        listen = f"TCP-LISTEN:{port},bind={HOST},fork,nodelay,backlog=4096"
        return [*_SOCAT, listen, f"TCP:{values['target']},nodelay"]
    file = place.folder / f"{name}.conf"
    text = {"haproxy": _HAPROXY, "nginx": _NGINX}[name]
    file.write_text(text.format(**values, folder=place.folder))
    return {"haproxy": ["haproxy", "-db", "-f"], "nginx": ["nginx", "-c"]}[name] + [str(file)]
