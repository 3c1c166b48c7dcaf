"""The inside node: ``python -m tests.bench.node MASTER_URI``.

It registers, prints its slave URI, and serves until its standard input ends.
"""

import os
import socket
import sys
from functools import partial

from rosproxy.demo.boundary import Boundary
from rosproxy.demo.node import Node
from rosproxy.demo.publisher import Publisher
from rosproxy.demo.wire import STRING, pack_string, send_header
from tests.integration.net import NODE

NAME = "/bench_inside"
FRAME = pack_string("x" * (2**20 - 8))  # with its two lengths exactly 1 MiB
OFFERED = 256 * len(FRAME)


class Topic(Publisher):
    """A topic that deals with a connection as ACTS says, once the headers are exchanged."""

    def serve(self, connection: socket.socket, header: dict[str, str]) -> None:
        connection.settimeout(None)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        send_header(connection, self._reply())
        ACTS[self.topic](connection)


def write(connection: socket.socket, size: int) -> None:
    for _ in range(size // len(FRAME)):
        connection.sendall(FRAME)


def echo(connection: socket.socket) -> None:
    while data := connection.recv(65536):
        connection.sendall(data)


endless, offer = partial(write, size=sys.maxsize), partial(write, size=OFFERED)
ACTS = {"/stream": endless, "/offer": offer, "/echo": echo}

if __name__ == "__main__":
    boundary = Boundary(leave_from=(("127.0.2.0/24", NODE),))
    node = Node(NAME, sys.argv[1], NODE, NODE, boundary)
    node.publishers |= {topic: Topic(NAME, topic, STRING) for topic in ACTS}
    node.start()
    if node.registered.wait(20):
        print(node.uri, flush=True)
        sys.stdin.read()
    os._exit(0)  # threads may hang in the middle of a write
