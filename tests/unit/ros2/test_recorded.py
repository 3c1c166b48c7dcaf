"""The proxy reads, rewrites and reports recorded datagrams of real participants."""

from collections.abc import Iterable
from contextlib import suppress
from socket import inet_aton

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.ros2.discovery.domain import Domain
from rosproxy.ros2.domain_settings import Outgoing
from rosproxy.ros2.protocol.addressing import may_be_discovery
from rosproxy.ros2.protocol.parameters import FastDdsPid
from rosproxy.ros2.protocol.ros_names import ros_node
from rosproxy.ros2.protocol.rtps import RtpsError, by_source, samples, source_vendor
from rosproxy.ros2.registry.matching import Comparison, compare
from rosproxy.ros2.registry.participants import EndpointKind, Participant
from rosproxy.ros2.rewriting.discovery import (
    BuiltinWriter,
    DiscoveryMessage,
    read_discovery,
    rewritten,
)
from rosproxy.shared.addresses import HostPort
from tests.unit.ros2.discovery.domains import HOST, NOW, B, make_domain, spdp
from tests.unit.ros2.recorded import PUBLISHER, SUBSCRIBER, VENDORS, Datagram, recorded

OF_EACH = pytest.mark.parametrize("vendor", VENDORS)
VENDOR_IDS = {"cyclone": b"\x01\x10", "jazzy": b"\x01\x0f", "kilted": b"\x01\x0f"}
ALL = [datagram for vendor in VENDORS for datagram in recorded(vendor)]


def messages(vendor: str, host: str = "") -> list[DiscoveryMessage]:
    """The recorded messages of an implementation, from both machines or from `host`."""
    return [
        read_discovery(message)
        for datagram in recorded(vendor)
        if datagram.host == (host or datagram.host)
        for message in by_source(datagram.content)
    ]


def led_out(pid: int, locator: HostPort) -> HostPort | None:
    return HostPort(HOST, 45000 + locator.port % 1000) if locator.host == PUBLISHER else None


def exported(message: DiscoveryMessage) -> bytes:
    return rewritten(message, led_out, lambda _: False)


def passed(domain: Domain, datagram: Datagram) -> list[Outgoing]:
    """The datagrams that a proxy between the two machines sends for a datagram."""
    host, _, port = datagram.target.partition(":")
    target = HostPort(host, int(port))
    content = datagram.content
    if datagram.host == PUBLISHER:
        if host != SUBSCRIBER:
            return domain.heard_inside(content, PUBLISHER, NOW)
        stand_ins = [
            p for p, users in domain.stand_ins.by_port.items() if users[0][1].target == target
        ]
        return [out for p in stand_ins for out in domain.at_stand_in(p, content, PUBLISHER, NOW)]
    if host != PUBLISHER:
        return domain.heard_outside(content, SUBSCRIBER, NOW)
    mappings = [
        p for p, (_, mapping) in domain.mappings.by_port.items() if mapping.target == target
    ]
    return [out for p in mappings for out in domain.at_range_port(p, content, SUBSCRIBER, NOW)]


@OF_EACH
def test_it_is_read(vendor: str) -> None:
    told = messages(vendor)
    assert {source_vendor(message.datagram) for message in told} == {VENDOR_IDS[vendor]}
    assert len({message.prefix for message in told}) == 2
    # Of Cyclone DDS the publisher says much of itself; Fast DDS has no fragments below 64 KB.
    assert any(message.fragments for message in told) is (vendor == "cyclone")
    last_words = [m for m in told if m.of_participant and m.of_participant.ended]
    assert {message.prefix for message in last_words} == {message.prefix for message in told}


@OF_EACH
def test_users_data_is_known_from_discovery(vendor: str) -> None:
    users = [datagram for datagram in recorded(vendor) if not may_be_discovery(datagram.content)]
    assert any(b"hello" in datagram.content for datagram in users)
    for datagram in users:
        for message in map(read_discovery, by_source(datagram.content)):
            assert not message.announcements
            assert not message.fragments


@OF_EACH
def test_no_address_of_inside_is_left_and_nothing_else_changes(vendor: str) -> None:
    changed = 0
    for message in messages(vendor, PUBLISHER):
        before = message.datagram
        after = exported(message)
        assert inet_aton(PUBLISHER) not in after
        assert len(after) == len(before)
        parameters = {
            at
            for announcement in message.announcements
            for p in announcement.parameters.parameters
            for at in range(p.offset, p.value.end)
        }
        differing = {at for at, byte in enumerate(before) if after[at] != byte}
        assert differing <= parameters
        changed += bool(differing)
    assert changed


@OF_EACH
def test_no_machine_takes_itself_for_the_other(vendor: str) -> None:
    """Both machines have the same machine id, like containers of the same image."""
    told = messages(vendor, PUBLISHER)
    after = [read_discovery(exported(message)) for message in told]
    assert (FastDdsPid.MACHINE_ID in _pids(told)) is (vendor == "kilted")
    assert FastDdsPid.MACHINE_ID not in _pids(after)
    assert len(_pids(after)) == len(_pids(told))
    if vendor != "cyclone":  # Cyclone DDS uses the parameter for something else
        assert any(_network_configurations(told))
        assert not any(_network_configurations(after))


def _pids(told: list[DiscoveryMessage]) -> list[int]:
    return [p.pid for m in told for a in m.announcements for p in a.parameters.parameters]


def _network_configurations(told: list[DiscoveryMessage]) -> list[int | None]:
    pid = FastDdsPid.NETWORK_CONFIGURATION
    return [a.parameters.number(m.datagram, pid) for m in told for a in m.announcements]


@OF_EACH
def test_two_that_meet_through_the_proxy(vendor: str) -> None:
    domain = make_domain(peers=(SUBSCRIBER,), lan_relay=None)
    sent = list[Outgoing]()
    nodes = set[str | None]()
    in_samples = set[str]()
    inside = set[tuple[EndpointKind, str]]()
    outside = set[tuple[EndpointKind, str]]()
    for datagram in recorded(vendor):
        sent += passed(domain, datagram)
        insiders = domain.inside.by_prefix.values()
        outsiders = domain.outside.by_prefix.values()
        every = [e for p in (*insiders, *outsiders) for e in p.endpoints.values()]
        in_samples |= {node for e in every for node in e.nodes}
        nodes |= {ros_node(e.topic, e.type_name) for e in every if e.kind is EndpointKind.READER}
        inside |= _endpoints(insiders)
        outside |= _endpoints(outsiders)
        assert compare(insiders, outsiders) == Comparison()
    assert (EndpointKind.WRITER, "rt/chatter") in inside
    assert (EndpointKind.READER, "rt/chatter") in outside
    # The recorded program of Cyclone DDS is no ROS node.
    assert nodes - {None} == (set() if vendor == "cyclone" else {"/talker", "/listener"})
    # User data to outside does not pass the proxy.
    assert in_samples == (set() if vendor == "cyclone" else {"/listener"})
    assert domain.refused.count == 0
    outwards = [out.datagram for out in sent if out.target.host == SUBSCRIBER]
    assert outwards
    assert all(inet_aton(PUBLISHER) not in datagram for datagram in outwards)
    assert not domain.inside.by_prefix  # both have ended
    assert not domain.outside.by_prefix


def test_fragments_of_cyclone_dds_go_on_as_a_whole() -> None:
    domain = make_domain(peers=(SUBSCRIBER,), lan_relay=None)
    sent = [out for datagram in recorded("cyclone") for out in passed(domain, datagram)]
    outwards = [out.datagram for out in sent if out.target.host == SUBSCRIBER]
    (found,) = [
        (sample, datagram)
        for datagram in outwards
        for sample in samples(datagram)
        if sample.writer == BuiltinWriter.PUBLICATIONS and not sample.is_key_only
    ]
    (sample, datagram) = found
    assert sample.fragments is None
    assert sample.payload
    total = {f.total for message in messages("cyclone") for _, f in message.fragments}
    assert {sample.payload.end - sample.payload.start} == total
    (announcement,) = read_discovery(datagram).announcements
    assert announcement.topic(datagram) == "rt/chatter"


def _endpoints(participants: Iterable[Participant]) -> set[tuple[EndpointKind, str]]:
    return {(e.kind, e.topic) for p in participants for e in p.endpoints.values()}


@given(st.sampled_from(ALL), st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 255))))
def test_nothing_made_of_it_breaks_the_proxy(
    datagram: Datagram, changes: list[tuple[int, int]]
) -> None:
    content = bytearray(datagram.content)
    for at, byte in changes:
        content[at % len(content)] = byte
    domain = make_domain(peers=(SUBSCRIBER,))
    domain.heard_inside(datagram.content, PUBLISHER, NOW)
    domain.heard_inside(bytes(content), PUBLISHER, NOW)
    domain.heard_outside(bytes(content), SUBSCRIBER, NOW)
    domain.heard_outside(spdp(B, SUBSCRIBER), SUBSCRIBER, NOW)
    for port in list(domain.mappings.by_port):
        domain.at_range_port(port, bytes(content), SUBSCRIBER, NOW)
    for port in list(domain.stand_ins.by_port):
        domain.at_stand_in(port, bytes(content), PUBLISHER, NOW)
    with suppress(RtpsError):
        exported(read_discovery(bytes(content)))
