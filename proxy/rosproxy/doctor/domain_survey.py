"""The participants on the networks inside, in all domains: each is asked to announce itself.

The proxy hears what is announced to the group of its own domain. It can't hear a participant of
another one, nor one that announces itself to its own machine alone
(``ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST``). Yet both answer at once when they hear a new
participant. So the doctor is a new participant for a moment: it announces itself to the groups of
all domains, and to all hosts (224.0.0.1, ff02::1) at the well-known ports of the proxy's domains.
It collects the answers, and ends with a dispose message. The doctor has no reader and no writer, so
it receives nothing else.
"""

import contextlib
import os
import socket
import time
from collections.abc import Collection, Iterable, Iterator
from ipaddress import ip_network

from rosproxy.doctor.facts import HeardParticipant
from rosproxy.forwarding import datagrams
from rosproxy.net.addresses import HostPort, is_inside, plain_address
from rosproxy.net.interfaces import address_into
from rosproxy.ros2.domain_settings import (
    PARTICIPANTS_TRIED,
    PORTS_PER_DOMAIN,
    SPDP_MULTICAST,
    SPDP_UNICAST,
)
from rosproxy.ros2.protocol.announcement import SPDP_ENDPOINTS, announcement, dispose_message
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.protocol.rtps import PREFIX, RtpsError, source_vendor
from rosproxy.ros2.registry.participants import Participant
from rosproxy.ros2.rewriting.announced_participant import traits
from rosproxy.ros2.rewriting.discovery import Announcement, read_discovery
from rosproxy.ros2.servers.groups import family_of, groups_of, send_through

DOMAINS = 233
"""Those whose ports exist: 0 to 232."""
ALL_HOSTS = {socket.AF_INET: "224.0.0.1", socket.AF_INET6: "ff02::1"}
WITHIN = 2.0
"""Seconds in which participants answer."""
# Seconds after which participants forget the doctor if its dispose message does not arrive.
LEASE = 5.0
MOST_HEARD = 200


def ask_participants(network: str, domains: Collection[int]) -> list[HeardParticipant]:
    """The participants that answer on a network (CIDR) of this machine; takes WITHIN.

    ``domains``: in these, participants that don't hear the group are asked as well.
    """
    with contextlib.suppress(ValueError, OSError):  # no network; gone, or without multicast
        inside_network = ip_network(network)
        own_address = address_into(inside_network)
        if is_inside(own_address, (inside_network,)):
            return _ask(own_address, domains)
    return []


def heard_participant(datagram: bytes, source: str) -> HeardParticipant | None:
    """The participant that announces itself in a datagram; None without one or its domain."""
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
    """The participants that answer on the network of this own address. Raises OSError."""
    by_prefix: dict[str, HeardParticipant] = {}
    with contextlib.closing(datagrams.bind(own_address, 0)) as sock:
        # Not heard on this machine: the proxy, which hears the groups, would take the doctor for
        # a participant.
        send_through(sock, own_address, loop=False)
        prefix = os.urandom(PREFIX)
        targets = list(_targets(own_address, domains))
        own_locator = HostPort(own_address, sock.getsockname()[1])
        _send(sock, announcement(prefix, [own_locator], LEASE, SPDP_ENDPOINTS), targets)
        deadline = time.monotonic() + WITHIN
        while len(by_prefix) < MOST_HEARD and (remaining := deadline - time.monotonic()) > 0:
            sock.settimeout(remaining)
            with contextlib.suppress(TimeoutError):
                datagram, sender = sock.recvfrom(datagrams.LARGEST_DATAGRAM)
                participant = heard_participant(datagram, plain_address(sender[0]))
                by_prefix |= {participant.guid_prefix: participant} if participant else {}
        _send(sock, dispose_message(prefix), targets)
    return list(by_prefix.values())


def _targets(own_address: str, domains: Collection[int]) -> Iterator[tuple[str, int]]:
    for domain in range(DOMAINS):
        for group in groups_of(own_address):
            yield group, SPDP_MULTICAST + PORTS_PER_DOMAIN * domain
    for domain in domains:
        first = SPDP_UNICAST + PORTS_PER_DOMAIN * domain
        # Every second port: the others are those of user data.
        for port in range(first, min(first + 2 * PARTICIPANTS_TRIED, 65536), 2):
            yield ALL_HOSTS[family_of(own_address)], port


def _send(sock: socket.socket, datagram: bytes, targets: Iterable[tuple[str, int]]) -> None:
    sock.settimeout(None)
    for target in targets:
        sock.sendto(datagram, target)


def _domain(announced: Announcement, datagram: bytes, source: str) -> int | None:
    """The domain that a participant says it is in, or else that of its well-known port."""
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
