"""The node of the streams: ``python -m tests.bench.node MASTER WIRE ADDRESS``.

A slave API in Python in front of a TCPROS server in C++, which is the source of the bytes. The node
publishes /stream (without end) and /echo (returns all bytes), prints the port of the server after
registering, and runs until killed.
"""

from __future__ import annotations

import subprocess
import sys
from typing import Any
from xmlrpc.client import ServerProxy
from xmlrpc.server import SimpleXMLRPCServer

NAME = "/bench_inside"
TOPICS = ("/stream", "/echo")
NO_MASTER = "none"


class SlaveApi:
    """The calls from master and subscribers."""

    def __init__(self, address: str, port: int) -> None:
        self._address = address
        self._port = port

    def _dispatch(self, method: str, parameters: tuple[Any, ...]) -> list[Any]:
        tcpros = ["TCPROS", self._address, self._port]
        values = {"requestTopic": tcpros, "getPid": 1, "getBusInfo": [], "getPublications": []}
        return [1, "", values.get(method, 0)]


def main(master: str, wire: str, address: str) -> None:
    with subprocess.Popen([wire, "source"], stdout=subprocess.PIPE, text=True) as source:
        assert source.stdout
        port = int(source.stdout.readline())
        server = SimpleXMLRPCServer((address, 0), logRequests=False, allow_none=True)
        server.register_instance(SlaveApi(address, port))
        if master != NO_MASTER:
            register(master, f"http://{address}:{server.server_address[1]}/")
        print("port", port, flush=True)
        server.serve_forever()


def register(master: str, uri: str) -> None:
    with ServerProxy(master) as proxy:
        for topic in TOPICS:
            reply: Any = proxy.registerPublisher(NAME, topic, "std_msgs/String", uri)
            assert reply[0] == 1, reply


if __name__ == "__main__":
    main(*sys.argv[1:])
