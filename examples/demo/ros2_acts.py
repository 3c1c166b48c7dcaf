"""The part of ROS 2 in the demonstration: a talker and a listener on either side, and their domain.

Nodes of ROS 2 have no master. Those inside announce themselves to the proxy at the domain's
well-known port, as real ones do with `ROS_STATIC_PEERS`; those outside to the proxy's first port,
and they are its peers. As with NAT, inside turns away every datagram from an outside address.

The domain is one that nobody on this machine has, neither real nodes nor another demonstration. A
domain is a row of 250 UDP ports, some of which DDS has no use for; holding one of these keeps other
demonstrations away, and nobody else (`reserve_domain`).
"""

from __future__ import annotations

import asyncio
import random
import socket
from collections.abc import Callable
from time import monotonic

from examples.demo.fake_http import is_free
from examples.demo.fake_participant import READER, WRITER, FakeParticipant
from examples.demo.players import RATE
from examples.demo.proxy_process import DemoError
from examples.demo.reliable_topics import ReliableReader, ReliableWriter
from examples.demo.rtps_messages import pack_string, unpack_string
from rosproxy.net.addresses import HostPort
from rosproxy.ros2.domain_settings import (
    PORTS_PER_DOMAIN,
    SPDP_MULTICAST,
    SPDP_UNICAST,
)
from rosproxy.ros2.rewriting.discovery import BuiltinWriter

DOMAINS = range(1, 31)
"""Those whose ports lie below what `free_ports` chooses from, and not the one that all have."""
RESERVING = SPDP_MULTICAST + 2
"""The port that is held, in domain 0: DDS has 7400, 7401, and those from 7410 on (9.6.2.3)."""


class Ros2Talker(FakeParticipant):
    """Publishes numbers from 1 on; `sent` are those that there was a subscriber for."""

    def __init__(self, name: str, address: str, topic: str) -> None:
        super().__init__(name, address, topic)
        self.writers[WRITER] = ReliableWriter(WRITER, durable=False)
        self.describe(WRITER, BuiltinWriter.PUBLICATIONS)
        self.number = 0
        self.sent: dict[int, float] = {}

    @property
    def connected(self) -> bool:
        """Whether somebody listens."""
        return bool(self.writers[WRITER].acknowledged)

    async def talk(self) -> None:
        """Publish until cancelled."""
        while True:
            self.number += 1
            if self.connected:
                self.sent[self.number] = monotonic()
            self.publish(pack_string(str(self.number)))
            await asyncio.sleep(1 / RATE)


class Ros2Listener(FakeParticipant):
    """Subscribes; `received` are the numbers with their times."""

    def __init__(self, name: str, address: str, topic: str) -> None:
        super().__init__(name, address, topic)
        self.readers[READER] = ReliableReader(READER)
        self.describe(READER, BuiltinWriter.SUBSCRIPTIONS)
        self.received: list[tuple[int, float]] = []

    @property
    def connected(self) -> bool:
        """Whether there is a publisher."""
        return bool(self.readers[READER].expected)

    def hear(self, payload: bytes) -> None:
        """Take in a message."""
        self.received.append((int(unpack_string(payload)), monotonic()))


class Ros2Acts:
    """The four nodes, and what is done with them; `domain` is theirs once they are there."""

    def __init__(self, robot: str, inside: tuple[str, str], admits: Callable[[str], bool]) -> None:
        first, second = inside
        self.talker = Ros2Talker("/inside/talker", first, "/from_inside")
        self.listener = Ros2Listener("/inside/listener", second, "/from_outside")
        self.far_talker = Ros2Talker("/outside/talker", robot, "/from_outside")
        self.far_listener = Ros2Listener("/outside/listener", robot, "/from_inside")
        self.inside: list[Ros2Talker | Ros2Listener] = [self.talker, self.listener]
        self.outside: list[Ros2Talker | Ros2Listener] = [self.far_talker, self.far_listener]
        self.nodes = [*self.inside, *self.outside]
        for node in self.inside:
            node.admits = admits
        self.domain = 0
        self._reserved: socket.socket | None = None

    async def start(self) -> None:
        """Choose a domain and start the nodes, which nobody is told of yet. Raises DemoError."""
        self.domain, self._reserved = reserve_domain()
        for node in self.nodes:
            await node.start()

    async def stop(self) -> None:
        """Stop the nodes."""
        for node in self.nodes:
            await node.stop()
        if self._reserved:
            self._reserved.close()

    def proxy_options(self) -> list[str]:
        """What the proxy is told."""
        peers = [f"--ros2-peer={node.locators[0]}" for node in self.outside]
        return ["--ros=1", "--ros=2", f"--ros2-domain={self.domain}", *peers]

    def announce_directly(self) -> None:
        """Have the talker inside announce itself to the listener outside, past the proxy."""
        self.talker.announce_to([self.far_listener.locators[0]])

    def announce_to_proxy(self, inside: str, outside: HostPort) -> None:
        """Have all announce themselves to the proxy, at its address inside, or its port outside."""
        well_known = HostPort(inside, SPDP_UNICAST + PORTS_PER_DOMAIN * self.domain)
        for node in self.inside:
            node.announce_to([well_known])
        for node in self.outside:
            node.announce_to([outside])

    def is_connected(self, since: float) -> bool:
        """Whether messages have come on both sides, and outside has heard from all inside."""
        both_hear = self.listener.received and self.far_listener.received
        return bool(both_hear) and self.are_heard(since)

    def are_heard(self, since: float) -> bool:
        """Whether outside has heard from all inside since then, by way of the proxy."""
        peers = self.far_listener.peers
        return all(
            node.prefix in peers and peers[node.prefix].heard >= since for node in self.inside
        )

    def addresses(self) -> dict[str, str]:
        """Where outside finds each node inside: for discovery, and for what users send."""
        told = {node.name: self.far_listener.peers[node.prefix] for node in self.inside}
        return {name: f"{peer.discovery} {peer.user}" for name, peer in told.items()}

    def seen(self, node: FakeParticipant) -> str:
        """Where the other side sends what users send to a node; empty if it doesn't know it yet."""
        other = self.far_listener if node in self.inside else self.talker
        peer = other.peers.get(node.prefix)
        return str(peer.user) if peer else ""


def reserve_domain() -> tuple[int, socket.socket]:
    """A domain that nobody on this machine has, and what reserves it. Raises DemoError."""
    for domain in random.sample(DOMAINS, len(DOMAINS)):
        offset = PORTS_PER_DOMAIN * domain
        reservation = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            reservation.bind(("", RESERVING + offset))
        except OSError:
            reservation.close()
            continue
        ports = SPDP_MULTICAST + offset, SPDP_UNICAST + offset
        if all(is_free(port, kind=socket.SOCK_DGRAM) for port in ports):
            return domain, reservation
        reservation.close()
    raise DemoError("every domain of ROS 2 is in use on this machine")
