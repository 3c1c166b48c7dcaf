"""The inside node: ``python -m tests.bench.node MASTER_URI``.

It registers, prints its slave URI, and serves until its standard input ends.
"""

import os
import socket
import sys

from rosproxy.demo.boundary import Boundary
from rosproxy.demo.node import Node
from rosproxy.demo.publisher import Publisher
from rosproxy.demo.wire import STRING, pack_string, send_header
from tests.integration.net import NODE

NAME = "/bench_inside"
FRAME = pack_string("x" * (2**20 - 8))  # with its two lengths exactly 1 MiB
FRAMES = 256  # that a subscriber of /offer is sent


class Topic(Publisher):
    """/stream writes without end, /offer writes 256 MiB, /echo sends back what comes."""

    def serve(self, connection: socket.socket, header: dict[str, str]) -> None:
        connection.settimeout(None)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        send_header(connection, self._reply())
        if self.topic == "/echo":
            while data := connection.recv(65536):
                connection.sendall(data)
        for _ in range({"/stream": sys.maxsize, "/offer": FRAMES}.get(self.topic, 0)):
            connection.sendall(FRAME)


if __name__ == "__main__":
    boundary = Boundary(leave_from=(("127.0.2.0/24", NODE),))
    node = Node(NAME, sys.argv[1], NODE, NODE, boundary)
    node.publishers |= {t: Topic(NAME, t, STRING) for t in ("/stream", "/offer", "/echo")}
    node.start()
    if node.registered.wait(20):
        print(node.uri, flush=True)
        sys.stdin.read()
    os._exit(0)  # threads may hang in the middle of a write
