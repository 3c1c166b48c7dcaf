"""Discovery at ports for user data, where implementations other than Fast DDS read discovery."""

import struct

import pytest

from rosproxy.ros2.discovery.domain import Domain
from rosproxy.ros2.domain_settings import Outgoing
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.protocol.rtps import FAST_DDS, NO_VENDOR, RTI, SubmessageId, submessages
from rosproxy.ros2.registry.participants import TrafficKind
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.policy.rules import RuleKind
from tests.unit.ros2.discovery.domains import (
    CYCLONE_DDS,
    INSIDE,
    NEAR,
    NOW,
    ROBOT,
    SEDP_WRITERS,
    STRANGER,
    A,
    B,
    allowance_left,
    dispose_message,
    everything,
    make_domain,
    of_vendor,
    reached_at,
    sedp,
    spdp,
)
from tests.unit.ros2.protocol.messages import data, fragment, message, payload, submessage

C = b"\x01\x0f" + bytes([3] * 10)
"""Another participant outside."""
USER = message(data(bytes(1200), writer=0x00001203), prefix=B)
TO_READER = struct.pack(">II", 0x000004C7, 0)
OF_WRITER = struct.pack(">II", 0, SEDP_WRITERS)
SEDP_BODY = sedp(B, ROBOT, 7000)[20:]
OTHERS = pytest.mark.parametrize("vendor", [CYCLONE_DDS, RTI, b"\xab\xcd"])


def deny(kind: RuleKind, _name: str, _address: str) -> bool:
    """A policy that denies topics in both directions, and allows services."""
    return kind not in (RuleKind.PUBLISH, RuleKind.SUBSCRIBE)


def met(vendor: bytes = CYCLONE_DDS, both_ways: bool = False, is_denied: bool = True) -> Domain:
    """A domain with A inside and B outside, each of a vendor."""
    domain = make_domain(judge=deny if is_denied else everything, both_ways=both_ways)
    domain.heard_inside(of_vendor(spdp(A, INSIDE), vendor), INSIDE, NOW)
    domain.heard_outside(of_vendor(spdp(B, ROBOT), vendor), ROBOT, NOW)
    return domain


def data_port(domain: Domain) -> int:
    """The port that leads to where A receives user data."""
    (port,) = [
        p
        for p, (_, mapping) in domain.mappings.by_port.items()
        if mapping.kind is TrafficKind.USER_DATA
    ]
    return port


def data_stand_in(domain: Domain, prefix: bytes = B) -> int:
    """The port that stands for where a participant outside receives user data."""
    mappings = domain.outside.by_prefix[prefix].mappings.values()
    (port,) = [mapping.port for mapping in mappings if mapping.kind is TrafficKind.USER_DATA]
    return port


def in_fragments(prefix: bytes) -> list[bytes]:
    """A reader or writer that a participant announces in two datagrams."""
    parameters = [
        (Pid.ENDPOINT_GUID, prefix + bytes([0, 0, 1, 3])),
        (Pid.TOPIC_NAME, struct.pack("<I", 11) + b"rt/chatter\0\0"),
        (Pid.ENTITY_NAME, bytes(120)),
    ]
    whole = payload(parameters)
    chunks = whole[:128], whole[128:]
    return [
        message(fragment(chunk, number, 128, len(whole), writer=SEDP_WRITERS), prefix=prefix)
        for number, chunk in enumerate(chunks, 1)
    ]


def kinds(sent: list[Outgoing]) -> list[list[int]]:
    """The submessages of each datagram."""
    return [[kind for kind, _, _ in submessages(out.datagram)] for out in sent]


GAP = [SubmessageId.GAP, SubmessageId.PAD]


@OTHERS
@pytest.mark.parametrize("source", [STRANGER, INSIDE])
def test_a_strangers_discovery_does_not_pass(vendor: bytes, source: str) -> None:
    """A reader of a denied topic, announced to the port for user data, got that topic's data."""
    domain = met(vendor, is_denied=False)
    port = data_port(domain)
    for datagram in (sedp(B, ROBOT, 7000), sedp(C, source, 7000), *in_fragments(B)):
        assert domain.at_range_port(port, datagram, source, NOW) == []
    assert domain.refused.count


@OTHERS
def test_a_peers_discovery_is_policed_and_led_elsewhere(vendor: bytes) -> None:
    domain = met(vendor, both_ways=True)
    port = data_port(domain)
    announced = sedp(B, ROBOT, 7000)
    assert domain.must_queue_at_range_port(port, announced, ROBOT)
    assert kinds(domain.at_range_port(port, announced, ROBOT, NOW)) == [GAP]
    domain = met(vendor, both_ways=True, is_denied=False)
    (sent,) = domain.at_range_port(data_port(domain), announced, ROBOT, NOW)
    assert sent.target == HostPort(INSIDE, 7411)
    assert [locator.host for locator in reached_at(sent.datagram)] == [NEAR]


def test_a_peers_discovery_in_fragments_is_policed() -> None:
    domain = met()
    port = data_port(domain)
    first, second = in_fragments(B)
    assert domain.at_range_port(port, first, ROBOT, NOW) == []
    assert kinds(domain.at_range_port(port, second, ROBOT, NOW)) == [GAP]


def test_fragments_at_both_ports_of_a_participant_do_not_make_a_whole() -> None:
    """Cyclone DDS joins fragments from all sockets."""
    domain = met()
    (meta,) = domain.mappings.by_port.keys() - {data_port(domain)}
    first, second = in_fragments(B)
    assert domain.at_range_port(meta, first, ROBOT, NOW) == []
    assert domain.at_range_port(data_port(domain), second, ROBOT, NOW) == []


def test_a_participant_that_has_not_announced_itself_is_not_read() -> None:
    domain = met(is_denied=False)
    assert domain.at_range_port(data_port(domain), sedp(C, ROBOT, 7000), ROBOT, NOW) == []


def test_discovery_is_charged_and_user_data_is_not() -> None:
    domain = met()
    port = data_port(domain)
    before = allowance_left(domain, ROBOT)
    domain.at_range_port(port, USER, ROBOT, NOW)
    assert allowance_left(domain, ROBOT) == before
    domain.at_range_port(port, sedp(B, ROBOT, 7000), ROBOT, NOW)
    assert allowance_left(domain, ROBOT) < before
    domain.rates.charge(ROBOT, int(before))
    assert domain.at_range_port(port, sedp(B, ROBOT, 7000), ROBOT, NOW) == []
    assert domain.at_range_port(port, USER, ROBOT, NOW)


@pytest.mark.parametrize("source", [ROBOT, STRANGER])
def test_user_data_passes_unread(source: str) -> None:
    domain = met()
    port = data_port(domain)
    assert not domain.must_queue_at_range_port(port, USER, source)
    assert domain.at_range_port(port, USER, source, NOW) == [Outgoing(HostPort(INSIDE, 7411), USER)]


@pytest.mark.parametrize("source", [ROBOT, STRANGER])
def test_fast_dds_ignores_discovery_there_and_nothing_is_read(source: str) -> None:
    domain = met(FAST_DDS)
    port = data_port(domain)
    before = allowance_left(domain, source)
    announced = sedp(B, ROBOT, 7000)
    assert not domain.must_queue_at_range_port(port, announced, source)
    assert domain.at_range_port(port, announced, source, NOW) == [
        Outgoing(HostPort(INSIDE, 7411), announced)
    ]
    assert allowance_left(domain, source) == before


DISGUISES = {
    "by INFO_SRC": message(submessage(0x0C, 0, bytes(4) + b"\2\3\1\x10" + B), SEDP_BODY, prefix=C),
    "behind HEADER_EXTENSION": message(submessage(0x00, 0, bytes(8)), SEDP_BODY, prefix=B),
    "behind INFO_REPLY": message(submessage(0x0F, 0, bytes(8)), SEDP_BODY, prefix=B),
    "behind a vendor's own": message(submessage(0x81, 0, bytes(4)), SEDP_BODY, prefix=B),
    "behind much user data": message(*[USER[20:]] * 16, SEDP_BODY, prefix=B),
    "in front of a broken end": message(SEDP_BODY, b"\x15\1\xff\xff", prefix=B),
    "without a length": message(SEDP_BODY[:2] + bytes(2) + SEDP_BODY[4:], prefix=B),
    "big-endian": message(data(bytes(40), writer=SEDP_WRITERS, little=False), prefix=B),
    "without a payload": message(data(writer=SEDP_WRITERS), prefix=B),
    "encrypted": message(submessage(0x31, 0, bytes(40)), prefix=B),
    "RTPS 2.5": b"RTPS\2\x05" + sedp(B, ROBOT, 7000)[6:],
    "RTPS 3.0": b"RTPS\3\0" + sedp(B, ROBOT, 7000)[6:],
    **{
        f"submessage {kind} {name}": message(submessage(kind, 0, ids + bytes(20)), prefix=B)
        for kind in (0x06, 0x07, 0x08, 0x12, 0x13)
        for name, ids in (("to a reader", TO_READER), ("of a writer", OF_WRITER))
    },
}


@pytest.mark.parametrize("disguise", DISGUISES)
@pytest.mark.parametrize("vendor", [FAST_DDS, CYCLONE_DDS, NO_VENDOR, b"\xab\xcd"])
def test_a_stranger_can_not_disguise_discovery(disguise: str, vendor: bytes) -> None:
    """Cyclone DDS reads up to a broken submessage, and skips unknown submessages."""
    domain = met(is_denied=False)
    datagram = of_vendor(DISGUISES[disguise], vendor)
    assert domain.at_range_port(data_port(domain), datagram, STRANGER, NOW) == []


@OTHERS
def test_what_inside_announces_at_a_stand_in_for_user_data_is_policed(vendor: bytes) -> None:
    domain = met(vendor, both_ways=True)
    port = data_stand_in(domain)
    announced = of_vendor(sedp(A, INSIDE, 7000), vendor)
    assert domain.must_queue_at_stand_in(port, announced, INSIDE)
    assert kinds(domain.at_stand_in(port, announced, INSIDE, NOW)) == [GAP]
    first, second = in_fragments(A)
    assert domain.at_stand_in(port, first, INSIDE, NOW) == []
    assert kinds(domain.at_stand_in(port, second, INSIDE, NOW)) == [GAP]
    said = message(USER[20:], prefix=A)
    assert domain.at_stand_in(port, said, INSIDE, NOW) == [Outgoing(HostPort(ROBOT, 7411), said)]


def test_nothing_is_read_at_a_stand_in_for_user_data_of_fast_dds() -> None:
    domain = met(FAST_DDS, both_ways=True)
    port = data_stand_in(domain)
    announced = sedp(A, INSIDE, 7000)
    assert not domain.must_queue_at_stand_in(port, announced, INSIDE)
    assert domain.at_stand_in(port, announced, INSIDE, NOW) == [
        Outgoing(HostPort(ROBOT, 7411), announced)
    ]


def test_one_participant_that_reads_discovery_has_a_shared_stand_in_read(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        "rosproxy.ros2.ports.stand_ins.order_for",
        lambda key, _: iter([20_000 + key.endswith("1")]),
    )
    domain = met(FAST_DDS, both_ways=True)
    announced = sedp(A, INSIDE, 7000)
    assert not domain.must_queue_at_stand_in(20_001, announced, INSIDE)
    domain.heard_outside(of_vendor(spdp(C, ROBOT, 7420)), ROBOT, NOW)
    assert {data_stand_in(domain), data_stand_in(domain, C)} == {20_001}
    assert domain.must_queue_at_stand_in(20_001, announced, INSIDE)
    assert kinds(domain.at_stand_in(20_001, announced, INSIDE, NOW)) == [GAP, GAP]


def test_a_forged_vendor_does_not_outlast_the_participants_own_word() -> None:
    """A forger announced the participant first, from the same address, with the vendor Fast DDS."""
    domain = met(FAST_DDS)
    port = data_port(domain)
    domain.heard_inside(of_vendor(spdp(A, INSIDE)), INSIDE, NOW + 1)
    assert domain.at_range_port(port, sedp(B, ROBOT, 7000), STRANGER, NOW + 1) == []
    domain.heard_inside(spdp(A, INSIDE), INSIDE, NOW + 2)
    assert domain.at_range_port(port, sedp(B, ROBOT, 7000), STRANGER, NOW + 2) == []


@pytest.mark.parametrize("vendor", [FAST_DDS, CYCLONE_DDS])
@pytest.mark.parametrize("is_named_first", [False, True])
def test_a_port_of_another_participant_at_the_address_is_read(
    vendor: bytes, is_named_first: bool
) -> None:
    """A participant may announce the discovery port of another participant for user data."""
    domain = make_domain()
    # The port for user data of C is the port for discovery of A.
    said = [of_vendor(spdp(A, INSIDE, 7410), vendor), spdp(C, INSIDE, 7409)]
    for datagram in reversed(said) if is_named_first else said:
        domain.heard_inside(datagram, INSIDE, NOW)
    mapping = domain.inside.by_prefix[C].mappings[HostPort(INSIDE, 7410)]
    assert domain.at_range_port(mapping.port, sedp(B, ROBOT, 7000), STRANGER, NOW) == []
    domain.heard_inside(of_vendor(dispose_message(A), vendor), INSIDE, NOW)
    assert domain.at_range_port(mapping.port, sedp(B, ROBOT, 7000), STRANGER, NOW)


def test_the_end_of_one_participant_leaves_the_ports_of_another_read() -> None:
    """Several participants of a program of Cyclone DDS have the same ports."""
    domain = met()
    domain.heard_inside(of_vendor(spdp(C, INSIDE)), INSIDE, NOW)
    port = domain.inside.by_prefix[C].mappings[HostPort(INSIDE, 7411)].port
    domain.heard_inside(of_vendor(dispose_message(A)), INSIDE, NOW)
    assert domain.at_range_port(port, sedp(B, ROBOT, 7000), STRANGER, NOW) == []


@pytest.mark.parametrize("both_ways", [False, True])
def test_user_data_is_counted_apart_from_discovery_at_the_same_port(both_ways: bool) -> None:
    """Cyclone DDS has a single port for both."""
    domain = make_domain(both_ways=both_ways)
    domain.heard_inside(of_vendor(spdp(A, INSIDE, data_port=7410)), INSIDE, NOW)
    domain.heard_outside(of_vendor(spdp(B, ROBOT, data_port=7410)), ROBOT, NOW)
    (insider,) = domain.inside.by_prefix.values()
    (outsider,) = domain.outside.by_prefix.values()
    (mapping,) = insider.mappings.values()
    (stand_in,) = outsider.mappings.values()
    from_inside = message(data(bytes(1200), writer=0x00001203), prefix=A)
    for discovery, user in ((sedp(B, ROBOT, 7000), USER), (sedp(A, INSIDE, 7000), from_inside)):
        acknowledgement = message(submessage(6, 0, TO_READER + bytes(16)), prefix=user[8:20])
        for datagram in (discovery, user, acknowledgement, user):
            if user is USER:
                assert domain.at_range_port(mapping.port, datagram, ROBOT, NOW)
            else:
                assert domain.at_stand_in(stand_in.port, datagram, INSIDE, NOW)
    for counted, size in ((mapping, len(USER)), (stand_in, len(from_inside))):
        assert (counted.user_datagrams, counted.user_bytes) == (2, 2 * size)
        assert counted.datagrams > 3
