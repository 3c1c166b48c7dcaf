"""ROS 2 in the demonstration: a talker and a listener on either side, and a free domain.

ROS 2 nodes have no master. Nodes inside announce themselves at the proxy's well-known port of the
domain, like real nodes with `ROS_STATIC_PEERS`. Nodes outside announce themselves at the first port
of the range, and are peers of the proxy. As with NAT, nodes inside reject every datagram from an
outside address.

Neither real nodes nor another demonstration on this machine use the domain. A domain is a row of
250 UDP ports, and DDS does not use all of these. `reserve_domain` holds an unused port to keep
other demonstrations away. Real nodes are not affected.
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
from rosproxy.ros2.rewriting.discovery import BuiltinWriter
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.domain_ports import (
    PORTS_PER_DOMAIN,
    SPDP_MULTICAST,
    first_unicast_port,
    multicast_port,
)

DOMAINS = range(1, 31)
"""Domains with ports below the range of `free_ports`, without the default domain 0."""
RESERVING = SPDP_MULTICAST + 2
"""The port that the demonstration holds, in domain 0. DDS uses 7400, 7401, and 7410 upwards
(9.6.2.3).
"""


class Ros2Talker(FakeParticipant):
    """Publishes the numbers from 1. `sent` has the numbers for which there was a subscriber."""

    def __init__(self, name: str, address: str, topic: str) -> None:
        super().__init__(name, address, topic)
        self.writers[WRITER] = ReliableWriter(WRITER, durable=False)
        self.describe(WRITER, BuiltinWriter.PUBLICATIONS)
        self.number = 0
        self.sent: dict[int, float] = {}

    @property
    def connected(self) -> bool:
        """Whether there is a subscriber."""
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
    """Subscribes. `received` has each number with its time."""

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
        """Note a message."""
        self.received.append((int(unpack_string(payload)), monotonic()))


class Ros2Acts:
    """The four nodes, and the actions on them. `start` sets `domain`."""

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
        """Choose a domain and start the nodes without announcements. Raises DemoError."""
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
        """The options of the proxy for ROS 2."""
        peers = [f"--ros2-peer={node.locators[0]}" for node in self.outside]
        return ["--ros=1", "--ros=2", f"--ros2-domain={self.domain}", *peers]

    def announce_directly(self) -> None:
        """Have the talker inside announce itself to the listener outside, past the proxy."""
        self.talker.announce_to([self.far_listener.locators[0]])

    def announce_to_proxy(self, inside: str, outside: HostPort) -> None:
        """Have all nodes announce themselves to the proxy, from inside or from outside."""
        well_known = HostPort(inside, first_unicast_port(self.domain))
        for node in self.inside:
            node.announce_to([well_known])
        for node in self.outside:
            node.announce_to([outside])

    def is_connected(self, since: float) -> bool:
        """Whether both sides have received messages, and outside knows all nodes inside."""
        both_hear = self.listener.received and self.far_listener.received
        return bool(both_hear) and self.are_heard(since)

    def are_heard(self, since: float) -> bool:
        """Whether outside has an announcement of each node inside since then."""
        peers = self.far_listener.peers
        return all(
            node.prefix in peers and peers[node.prefix].heard >= since for node in self.inside
        )

    def addresses(self) -> dict[str, str]:
        """The outside addresses of each node inside: for discovery, and for user data."""
        told = {node.name: self.far_listener.peers[node.prefix] for node in self.inside}
        return {name: f"{peer.discovery} {peer.user}" for name, peer in told.items()}

    def seen(self, node: FakeParticipant) -> str:
        """The address at which the other side sends user data to a node; empty before discovery."""
        other = self.far_listener if node in self.inside else self.talker
        peer = other.peers.get(node.prefix)
        return str(peer.user) if peer else ""


def reserve_domain() -> tuple[int, socket.socket]:
    """A domain that no program on this machine uses, and the reservation. Raises DemoError."""
    for domain in random.sample(DOMAINS, len(DOMAINS)):
        reservation = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            reservation.bind(("", RESERVING + PORTS_PER_DOMAIN * domain))
        except OSError:
            reservation.close()
            continue
        ports = multicast_port(domain), first_unicast_port(domain)
        if all(is_free(port, kind=socket.SOCK_DGRAM) for port in ports):
            return domain, reservation
        reservation.close()
    raise DemoError("every domain of ROS 2 is in use on this machine")
