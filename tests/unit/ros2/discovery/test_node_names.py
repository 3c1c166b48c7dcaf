"""The names of nodes come from samples of ros_discovery_info that the proxy passes on."""

from __future__ import annotations

import struct
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.ros2.discovery.domain import Domain
from rosproxy.ros2.protocol.graph_sample import MOST_NODES, node_names
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.protocol.rtps import RtpsError
from rosproxy.shared.addresses import HostPort
from tests.unit.ros2.discovery.domains import (
    INSIDE,
    NOW,
    ROBOT,
    SEDP_WRITERS,
    STRANGER,
    A,
    B,
    make_domain,
    spdp,
)
from tests.unit.ros2.protocol.messages import data, message, payload

WRITER = 0x00000103
ENTITY = WRITER.to_bytes(4, "big")
NAMES = st.lists(
    st.from_regex(r"[a-zA-Z_][a-zA-Z0-9_]{0,9}", fullmatch=True).map(str.encode), max_size=4
)


def text(value: bytes, mark: str = "<") -> bytes:
    """A text in CDR."""
    return struct.pack(mark + "I", len(value) + 1) + value + b"\0" + bytes(-(len(value) + 1) % 4)


def graph(*nodes: tuple[bytes, bytes], guid_size: int = 16, mark: str = "<") -> bytes:
    """A sample with nodes, each with three readers and a writer."""
    sample = bytes([0, mark == "<", 0, 0]) + bytes(guid_size) + struct.pack(mark + "I", len(nodes))
    for namespace, name in nodes:
        sample += text(namespace, mark) + text(name, mark)
        for count in (3, 1):
            sample += struct.pack(mark + "I", count) + bytes([7]) * count * guid_size
    return sample


def announced(prefix: bytes, topic: bytes = b"ros_discovery_info") -> bytes:
    parameters = [
        (Pid.ENDPOINT_GUID, prefix + ENTITY),
        (Pid.TOPIC_NAME, text(topic)),
        (Pid.TYPE_NAME, text(b"Graph")),
    ]
    return message(data(payload(parameters), writer=SEDP_WRITERS), prefix=prefix)


def port_of(domain: Domain, port: int) -> int:
    """The port of the range for a locator inside."""
    target = HostPort(INSIDE, port)
    return next(p for p, (_, m) in domain.mappings.by_port.items() if m.target == target)


def met(topic: bytes = b"ros_discovery_info") -> Domain:
    """A domain in which a participant outside has announced a writer."""
    domain = make_domain()
    domain.heard_inside(spdp(A, INSIDE), INSIDE, NOW)
    domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    domain.at_range_port(port_of(domain, 7410), announced(B, topic), ROBOT, NOW)
    return domain


def send(domain: Domain, sample: bytes, source: str = ROBOT, prefix: bytes = B) -> None:
    datagram = message(data(sample, writer=WRITER), prefix=prefix)
    (passed,) = domain.at_range_port(port_of(domain, 7411), datagram, source, NOW)
    assert passed.datagram == datagram


def known(domain: Domain) -> tuple[str, ...]:
    return domain.outside.by_prefix[B].endpoints[ENTITY].nodes


@given(NAMES, st.sampled_from([16, 24]), st.sampled_from("<>"))
def test_names_of_all_releases(names: list[bytes], guid_size: int, mark: str) -> None:
    sample = graph(*((b"/arm", n) for n in names), guid_size=guid_size, mark=mark)
    assert node_names(sample) == tuple(f"/arm/{name.decode()}" for name in names)


@pytest.mark.parametrize(
    "sample",
    [
        b"",
        graph((b"/", b"<img>")),
        graph((b"/", b"a\n")),
        graph((b"/", b"")),
        graph((b"/", b"a" * 256)),
        graph(*[(b"/", b"a")] * (MOST_NODES + 1)),
        graph(*[(b"/" + b"a" * 200, b"b")] * 21),
        graph((b"/", b"a")) + bytes(4),
        graph((b"/", b"a"))[:-4],
    ],
)
def test_an_impossible_sample_is_refused(sample: bytes) -> None:
    with pytest.raises(RtpsError):
        node_names(sample)


@given(st.binary(max_size=200), st.integers(0, 90), st.integers(0, 2**32 - 1))
def test_any_bytes_are_names_or_refused(rest: bytes, offset: int, number: int) -> None:
    sample = bytearray(graph((b"/", b"talker")) + rest)
    struct.pack_into("<I", sample, offset, number)
    with suppress(RtpsError):
        assert len(node_names(bytes(sample))) <= MOST_NODES


def test_the_latest_sample_holds_and_a_repeated_announcement_forgets_nothing() -> None:
    domain = met()
    assert known(domain) == ()
    send(domain, graph((b"/", b"a"), (b"/arm", b"b")))
    assert known(domain) == ("/a", "/arm/b")
    domain.at_range_port(port_of(domain, 7410), announced(B), ROBOT, NOW)
    assert known(domain) == ("/a", "/arm/b")
    send(domain, b"other data")
    assert known(domain) == ("/a", "/arm/b")
    send(domain, graph())
    assert known(domain) == ()


def test_only_the_participant_itself_tells_its_nodes() -> None:
    domain = met()
    send(domain, graph((b"/", b"forged")), STRANGER)
    send(domain, graph((b"/", b"forged")), prefix=A)
    assert known(domain) == ()
    other = met(b"rt/chatter")
    send(other, graph((b"/", b"forged")))
    assert known(other) == ()


def test_samples_beyond_the_allowance_pass_unread() -> None:
    domain = met()
    for _ in range(6_000):
        send(domain, graph((b"/", b"a")))
    send(domain, graph((b"/", b"b")))
    assert known(domain) == ("/a",)


def test_with_both_directions_names_inside_are_known() -> None:
    domain = make_domain(both_ways=True)
    domain.heard_inside(spdp(A, INSIDE), INSIDE, NOW)
    domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    ports = {users[0][1].target.port: p for p, users in domain.stand_ins.by_port.items()}
    domain.at_stand_in(ports[7410], announced(A), INSIDE, NOW)
    datagram = message(data(graph((b"/", b"camera")), writer=WRITER), prefix=A)
    assert domain.at_stand_in(ports[7411], datagram, INSIDE, NOW)
    assert domain.inside.by_prefix[A].endpoints[ENTITY].nodes == ("/camera",)
