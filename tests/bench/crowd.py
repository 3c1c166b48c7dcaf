"""Many inside nodes in one process:

    python -m tests.bench.crowd MASTER_URI ADDRESS PORT COUNT [AT_ONCE [NAME]]

The nodes have slave APIs on COUNT ports, beginning with PORT. Each node publishes ten topics.
AT_ONCE nodes register at the same time, each node on a separate connection. The program prints the
seconds until all nodes are registered, and serves the slave APIs for an hour.
"""

from __future__ import annotations

import asyncio
import os
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from http.client import HTTPConnection
from urllib.parse import urlsplit
from xmlrpc.client import dumps, loads

TOPICS = 10
AT_ONCE = "8"
NAME = "crowd"
STRING = "std_msgs/String"


class Slave(asyncio.Protocol):
    """A connection to the slave API of a node."""

    def __init__(self, name: str, number: int) -> None:
        self._name = name
        self._number = number
        self._data = b""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        self._data += data
        head, end, body = self._data.partition(b"\r\n\r\n")
        if end and len(body) >= int(head.lower().partition(b"content-length:")[2].split()[0]):
            self._data = b""
            method = body.partition(b"<methodName>")[2].partition(b"<")[0].decode()
            reply = dumps((answer(method, self._name, self._number),), methodresponse=True).encode()
            first = b"HTTP/1.1 200 OK\r\nContent-Type: text/xml\r\nContent-Length: %d\r\n\r\n"
            self._transport.write(first % len(reply) + reply)


def answer(method: str, name: str, number: int) -> list[object]:
    if method == "getPid":
        return [1, "", os.getpid()]
    if method == "getPublications":
        return [1, "", [[topic, STRING] for topic in topics(name, number)]]
    if method == "requestTopic":
        return [1, "ready", ["TCPROS", "nowhere", 9]]
    return [1, "", []]


def topics(name: str, number: int) -> list[str]:
    return [f"/{name}/{number}/{index}" for index in range(TOPICS)]


def register(master: str, uri: str, name: str, number: int) -> None:
    """Register the topics of a node on a kept connection, as a node does at the start."""
    http = HTTPConnection(urlsplit(master).netloc, timeout=60)
    for topic in topics(name, number):
        body = dumps((f"/{name}_{number}", topic, STRING, uri), "registerPublisher").encode()
        http.request("POST", "/", body, {"Content-Type": "text/xml"})
        (reply,), _ = loads(http.getresponse().read())
        assert isinstance(reply, list)
        assert reply[0] == 1, reply
    http.close()


async def main(
    master: str, address: str, port: str, count: str, at_once: str = AT_ONCE, name: str = NAME
) -> None:
    loop = asyncio.get_running_loop()
    loop.set_default_executor(ThreadPoolExecutor(int(at_once)))
    ports = range(int(port), int(port) + int(count))
    for number, own in enumerate(ports):
        await loop.create_server(partial(Slave, name, number), address, own)
    started = time.perf_counter()
    uris = [f"http://{address}:{own}/" for own in ports]
    await asyncio.gather(
        *(asyncio.to_thread(register, master, uri, name, n) for n, uri in enumerate(uris))
    )
    print("registered", time.perf_counter() - started, flush=True)
    await asyncio.sleep(3600)


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
