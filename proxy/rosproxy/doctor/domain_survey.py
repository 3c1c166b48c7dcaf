"""Finds the participants on the networks inside, in all domains.

The proxy hears announcements to the multicast group of its own domains. The proxy hears neither a
participant in another domain, nor a participant that announces itself only to its own machine
(``ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST``). But each participant answers the announcement of a
new participant at once. So the doctor becomes a participant for ANSWER_TIMEOUT_S. The doctor
announces itself to the groups of all domains, and to all hosts (224.0.0.1, ff02::1) at the
well-known ports of the proxy's domains. The doctor collects the answers, and ends with a dispose
message. The doctor has no reader and no writer, so participants send nothing else.
"""

import contextlib
import os
import socket
import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from ipaddress import ip_network

from rosproxy.doctor.facts import HeardParticipant
from rosproxy.forwarding import datagrams
from rosproxy.ros2.domain_settings import PARTICIPANTS_TRIED
from rosproxy.ros2.protocol.announcement import SPDP_ENDPOINTS, announcement, dispose_message
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.protocol.rtps import PREFIX_BYTES, RtpsError, source_vendor
from rosproxy.ros2.registry.participants import Participant
from rosproxy.ros2.rewriting.announced_participant import traits
from rosproxy.ros2.rewriting.discovery import Announcement, read_discovery
from rosproxy.ros2.servers.groups import family_of, groups_of, send_through
from rosproxy.shared.addresses import HostPort, is_inside, plain_address
from rosproxy.shared.domain_ports import (
    LAST_DOMAIN,
    PORTS_PER_DOMAIN,
    SPDP_MULTICAST,
    first_unicast_port,
    multicast_port,
)
from rosproxy.shared.machine.interfaces import address_into

ALL_HOSTS = {socket.AF_INET: "224.0.0.1", socket.AF_INET6: "ff02::1"}
ANSWER_TIMEOUT_S = 2.0
"""Seconds for which the doctor collects answers."""
LEASE_DURATION_S = 5.0
"""The lease duration of the doctor in seconds. Participants that miss the dispose message forget
the doctor after this time."""
MOST_HEARD = 200
"""Participants on a network that the doctor collects at most."""
MOST_AT_ADDRESS = 32
"""Of these, participants at an address at most: a container has a few processes."""


def ask_participants(network: str, domains: Collection[int]) -> list[HeardParticipant]:
    """The participants that answer on a network (CIDR) of this machine, within ANSWER_TIMEOUT_S.

    ``domains``: in these domains, the doctor also asks participants that don't hear the group.
    Empty if this machine is not in the network, or if the network has no multicast.
    """
    with contextlib.suppress(ValueError, OSError):  # no valid network; gone, or no multicast
        inside_network = ip_network(network)
        own_address = address_into(inside_network)
        if is_inside(own_address, (inside_network,)):
            return _ask(own_address, domains)
    return []


def heard_participant(datagram: bytes, source: str) -> HeardParticipant | None:
    """The participant that announces itself in a datagram.

    None for any other datagram, for a dispose message, and if the domain is unknown.
    """
    try:
        message = read_discovery(datagram)
        prefix = message.prefix
        announced = message.of_participant
        vendor = source_vendor(datagram)
    except RtpsError:
        return None
    domain = _domain(announced, datagram, source) if announced and not announced.ended else None
    if domain is None:
        return None
    participant = Participant(prefix, source, vendor, 0.0)
    return HeardParticipant(domain, participant.guid_prefix, source, participant.vendor_name)


def _ask(own_address: str, domains: Collection[int]) -> list[HeardParticipant]:
    """The participants that answer on the network of an own address.

    Raises OSError if the network takes no announcement. If the network fails later, the answers
    until then count.
    """
    by_prefix: dict[str, HeardParticipant] = {}
    at_address = Counter[str]()
    with contextlib.closing(datagrams.bind(own_address, 0)) as sock:
        # Without multicast loop: the proxy on this machine would count the doctor as a participant.
        send_through(sock, own_address, loop=False)
        prefix = os.urandom(PREFIX_BYTES)
        targets = list(_targets(own_address, domains))
        own_locator = HostPort(own_address, sock.getsockname()[1])
        _send(sock, announcement(prefix, [own_locator], LEASE_DURATION_S, SPDP_ENDPOINTS), targets)
        with contextlib.suppress(OSError):
            for participant in _answers(sock):
                if at_address[participant.address] < MOST_AT_ADDRESS:
                    at_address[participant.address] += participant.guid_prefix not in by_prefix
                    by_prefix[participant.guid_prefix] = participant
                if len(by_prefix) == MOST_HEARD:
                    break
            _send(sock, dispose_message(prefix), targets)
    return list(by_prefix.values())


def _answers(sock: socket.socket) -> Iterator[HeardParticipant]:
    """Yield each participant that answers within ANSWER_TIMEOUT_S. Raises OSError."""
    deadline = time.monotonic() + ANSWER_TIMEOUT_S
    while (remaining := deadline - time.monotonic()) > 0:
        sock.settimeout(remaining)
        try:
            datagram, sender = sock.recvfrom(datagrams.LARGEST_DATAGRAM)
        except TimeoutError:
            return
        if participant := heard_participant(datagram, plain_address(sender[0])):
            yield participant


def _targets(own_address: str, domains: Collection[int]) -> Iterator[tuple[str, int]]:
    for domain in range(LAST_DOMAIN + 1):
        for group in groups_of(own_address):
            yield group, multicast_port(domain)
    for domain in domains:
        first = first_unicast_port(domain)
        # Every second port: the ports in between are for user data.
        for port in range(first, min(first + 2 * PARTICIPANTS_TRIED, 65536), 2):
            yield ALL_HOSTS[family_of(own_address)], port


def _send(sock: socket.socket, datagram: bytes, targets: Iterable[tuple[str, int]]) -> None:
    sock.settimeout(None)
    for target in targets:
        sock.sendto(datagram, target)


def _domain(announced: Announcement, datagram: bytes, source: str) -> int | None:
    """The domain that a participant announces, else the domain of its port for discovery.

    None without such a port.
    """
    domain = traits(announced, datagram, source).domain
    if domain is not None:
        return domain
    ports = (
        locator.port
        for pid, locator in announced.reached_at(datagram)
        if pid == Pid.METATRAFFIC_UNICAST_LOCATOR and locator.port >= SPDP_MULTICAST
    )
    port = next(ports, None)
    return None if port is None else (port - SPDP_MULTICAST) // PORTS_PER_DOMAIN
