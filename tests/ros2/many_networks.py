"""Joins more networks than a socket may, and later networks, and prints received sources as JSON.

Runs in a separate network namespace, and makes and removes the networks there.
"""

import asyncio
import json
import socket
import subprocess
from collections.abc import Iterator

from rosproxy.ros2.servers.groups import GROUP, GroupSockets, send_through
from tests.integration.net import PATIENCE

PORT = 7400
AT_ONCE = 25
IN_ALL = 60
MESSAGE = b"message"
END = b"end"
"""The datagrams of a test: after the end, a socket has received everything before."""


class Hearing:
    """The received datagrams of the group. ``opened`` counts sockets."""

    def __init__(self) -> None:
        self.loop = asyncio.get_running_loop()
        self.sources = list[str]()
        self.ends = list[str]()
        self.opened = 0
        self.groups = GroupSockets(PORT, self._begin, self._end)
        self.groups.open([socket.AF_INET])

    def _begin(self, sock: socket.socket) -> None:
        self.opened += 1
        self.loop.add_reader(sock, self._take, sock)

    def _take(self, sock: socket.socket) -> None:
        datagram, (source, _) = sock.recvfrom(100)
        (self.sources if datagram == MESSAGE else self.ends).append(source)

    def _end(self, sock: socket.socket) -> None:
        self.loop.remove_reader(sock)
        sock.close()

    async def heard(self, addresses: list[str]) -> list[str]:
        """The received sources, after a datagram through the network of each address."""
        self.sources.clear()
        self.ends.clear()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            for datagram in (MESSAGE, END):
                for address in addresses:
                    send_through(out, address, loop=True)
                    out.sendto(datagram, (GROUP, PORT))
        async with asyncio.timeout(PATIENCE):
            while not {*addresses} <= {*self.ends}:
                await asyncio.sleep(0.01)
        return sorted(self.sources)


def ip(command: str) -> None:
    subprocess.run(["ip", *command.split()], check=True)


def networks() -> Iterator[str]:
    """Make a network for each step, and yield this machine's address there."""
    for number in range(IN_ALL):
        ip(f"link add d{number} type veth peer name e{number}")
        ip(f"addr add 10.60.{number}.1/24 dev d{number}")
        ip(f"link set d{number} up")
        yield f"10.60.{number}.1"


async def main() -> None:
    hearing = Hearing()
    coming = networks()
    present = [next(coming) for _ in range(AT_ONCE)]
    joined = [len(hearing.groups.join(present))]
    first = await hearing.heard(present)
    sockets = [hearing.opened]
    for number, address in enumerate(coming):
        ip(f"link del d{number}")
        present = [*present[1:], address]
        joined.append(len(hearing.groups.join(present)))
    last = await hearing.heard(present)
    sockets.append(hearing.opened)
    second_address = "10.60.59.2"
    ip(f"addr add {second_address}/24 dev d59")
    hearing.groups.join([present[-1], second_address])
    hearing.groups.join([second_address])
    by_second = await hearing.heard([second_address])
    hearing.groups.close()
    print(json.dumps({"joined": joined, "heard": [len(first), len(last), len(by_second)],
                      "twice": [len(s) - len(set(s)) for s in (first, last, by_second)],
                      "sockets": sockets}))  # fmt: skip


if __name__ == "__main__":
    asyncio.run(main())
