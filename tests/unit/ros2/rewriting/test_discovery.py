"""Discovery: announcements, and rewritten locators."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.ros2.protocol.locators import pack_locator
from rosproxy.ros2.protocol.parameters import OLD_LOCATORS, Pid
from rosproxy.ros2.protocol.rtps import RtpsError
from rosproxy.ros2.rewriting.discovery import (
    MULTICAST,
    UNICAST,
    Announcement,
    BuiltinWriter,
    read_discovery,
    rewritten,
)
from rosproxy.shared.addresses import HostPort
from tests.unit.ros2.protocol.messages import (
    data,
    fragment,
    message,
    order,
    parameter_list,
    payload,
    submessage,
)

BOTH = pytest.mark.parametrize("little", [True, False], ids=["little", "big"])
INSIDE = "172.30.0.5"
HOST = "10.0.0.1"


def nothing(told: Announcement) -> bool:
    return False


def participant(little: bool = True) -> bytes:
    """An announcement like that of Fast DDS: two addresses, multicast, shared memory."""
    mark = order(little)
    shared_memory = struct.pack(mark + "iI", 16, 7412) + bytes(16)
    parameters = [
        (Pid.PARTICIPANT_GUID, bytes(range(16))),
        (Pid.METATRAFFIC_UNICAST_LOCATOR, pack_locator(HostPort(INSIDE, 7412), mark)),
        (Pid.METATRAFFIC_MULTICAST_LOCATOR, pack_locator(HostPort("239.255.0.1", 7400), mark)),
        (Pid.DEFAULT_UNICAST_LOCATOR, pack_locator(HostPort(INSIDE, 7413), mark)),
        (Pid.DEFAULT_UNICAST_LOCATOR, pack_locator(HostPort("127.0.0.1", 7413), mark)),
        (Pid.DEFAULT_UNICAST_LOCATOR, shared_memory),
        (0x8010, b"vendor's"),
    ]
    return message(
        submessage(0x09, 0, bytes(8), little), data(payload(parameters, little), little=little)
    )


@BOTH
def test_a_participant_announces_where_it_is_reached(little: bool) -> None:
    datagram = participant(little)
    (announcement,) = read_discovery(datagram).announcements
    assert (announcement.writer, announcement.ended) == (BuiltinWriter.PARTICIPANTS, False)
    assert list(announcement.reached_at(datagram)) == [
        (Pid.METATRAFFIC_UNICAST_LOCATOR, HostPort(INSIDE, 7412)),
        (Pid.DEFAULT_UNICAST_LOCATOR, HostPort(INSIDE, 7413)),
        (Pid.DEFAULT_UNICAST_LOCATOR, HostPort("127.0.0.1", 7413)),
    ]


@BOTH
def test_each_locator_leads_to_a_port_and_what_can_not_be_led_is_gone(little: bool) -> None:
    mappings = {7412: 45000, 7413: 45001}

    def lead(pid: int, locator: HostPort) -> HostPort | None:
        return HostPort(HOST, mappings[locator.port]) if locator.host == INSIDE else None

    before = participant(little)
    after = rewritten(read_discovery(before), lead, nothing)
    assert len(after) == len(before)
    (announcement,) = read_discovery(after).announcements
    assert list(announcement.reached_at(after)) == [
        (Pid.METATRAFFIC_UNICAST_LOCATOR, HostPort(HOST, 45000)),
        (Pid.DEFAULT_UNICAST_LOCATOR, HostPort(HOST, 45001)),
    ]
    pids = [parameter.pid for parameter in announcement.parameters.parameters]
    assert pids.count(Pid.PAD) == 3
    assert not set(MULTICAST) & set(pids)
    (vendor,) = announcement.parameters.all(0x8010)
    assert after[vendor.value.start : vendor.value.end] == b"vendor's"


@BOTH
def test_parameters_that_make_two_machines_look_alike_are_removed(little: bool) -> None:
    """Between containers with the same machine id and MAC address, Fast DDS sends no message."""
    told = [(0x8003, b"machine "), (0x8006, bytes([8] * 8)), (0x8007, bytes([7] * 4))]
    datagram = message(data(payload([*told, (0x8010, b"vendor's")], little), little=little))
    for vendor in (b"\x01\x0f", b"\x00\x00"):  # no vendor means Fast DDS to Fast DDS
        before = datagram[:6] + vendor + datagram[8:]
        after = rewritten(read_discovery(before), lambda *_: None, nothing)
        (announcement,) = read_discovery(after).announcements
        assert {p.pid for p in announcement.parameters.parameters} == {Pid.PAD, 0x8007, 0x8010}
        assert announcement.parameters.number(after, 0x8007) == 0
    of_cyclone = datagram[:6] + b"\x01\x10" + datagram[8:]
    assert rewritten(read_discovery(of_cyclone), lambda *_: None, nothing) == of_cyclone


def test_old_locators_are_gone() -> None:
    """By old locators a participant inside could make outside send to any address."""
    datagram = message(data(payload([(pid, bytes([10, 0, 0, 7])) for pid in OLD_LOCATORS])))
    after = rewritten(read_discovery(datagram), lambda *_: None, nothing)
    (announcement,) = read_discovery(after).announcements
    assert {p.pid for p in announcement.parameters.parameters} == {Pid.PAD}


def endpoint(*parameters: tuple[int, bytes]) -> bytes:
    topic = (Pid.TOPIC_NAME, b"\4\0\0\0rt/\0")
    return data(payload([topic, *parameters]), writer=BuiltinWriter.PUBLICATIONS)


def test_a_datagram_has_so_many_parameters() -> None:
    """A datagram with 16,000 parameters blocked the proxy for 14 ms."""
    parameters = [(0x1234, b"")] * 400
    assert len(read_discovery(message(*[endpoint(*parameters)] * 10)).announcements) == 10
    with pytest.raises(RtpsError, match="more than 4096 parameters"):
        read_discovery(message(*[endpoint(*parameters)] * 11))


@pytest.mark.parametrize("pid", [*UNICAST, *MULTICAST])
def test_a_datagram_has_so_many_locators(pid: int) -> None:
    locators = [(pid, pack_locator(HostPort(INSIDE, 7412), "<"))] * 100
    assert len(read_discovery(message(*[endpoint(*locators)] * 10)).announcements) == 10
    with pytest.raises(RtpsError, match="more than 1024 locators"):
        read_discovery(message(*[endpoint(*locators)] * 11))


def test_discovery_with_a_checksum_is_refused() -> None:
    """After a rewrite the checksum is wrong, and the receiver silently drops the message."""
    told = data(payload([(Pid.PARTICIPANT_GUID, bytes(range(16)))]))
    with_checksum = submessage(0x00, 0x20, bytes(8))
    with pytest.raises(RtpsError, match="checksum"):
        read_discovery(message(with_checksum, told))
    assert read_discovery(message(submessage(0x00, 0x02, bytes(8)), told)).announcements
    assert not read_discovery(message(with_checksum)).announcements
    crc = message(submessage(0x80, 0, bytes(8)), told)
    assert read_discovery(crc).announcements  # for Fast DDS this kind has another meaning
    with pytest.raises(RtpsError, match="checksum"):
        read_discovery(crc[:6] + b"\x01\x01" + crc[8:])


@pytest.mark.parametrize(
    ("status", "ended"),
    [(0, False), (1, True), (2, True), (3, True), (4, False), (0x80000000, False)],
)
@BOTH
def test_the_end_of_a_participant_is_told_by_its_status(
    status: int, ended: bool, little: bool
) -> None:
    qos = parameter_list([(Pid.STATUS_INFO, status.to_bytes(4, "big"))], little)
    datagram = message(data(payload([], little), qos=qos, little=little))
    assert read_discovery(datagram).announcements[0].ended is ended


def test_a_key_alone_tells_an_end_as_well() -> None:
    datagram = message(data(payload([(Pid.PARTICIPANT_GUID, bytes(range(16)))]), key=True))
    assert read_discovery(datagram).announcements[0].ended


def test_user_data_and_fragments_are_left_alone() -> None:
    user = data(payload([(Pid.UNICAST_LOCATOR, bytes(24))]), writer=0x00001203)
    data_frag = fragment(payload([(Pid.UNICAST_LOCATOR, bytes(24))]), 1, 20, 90)
    datagram = message(user, data_frag)
    assert read_discovery(datagram).announcements == ()
    assert rewritten(read_discovery(datagram), lambda pid, locator: None, nothing) == datagram


def test_an_announcement_without_an_end_is_refused() -> None:
    with pytest.raises(RtpsError):
        read_discovery(message(data(b"\0\3\0\0\x32\0\x18\0")))


LOCATORS = st.tuples(
    st.sampled_from([*UNICAST, *MULTICAST, Pid.TYPE_NAME, Pid.ENTITY_NAME]),
    st.binary(min_size=24, max_size=24),
)


@given(st.lists(LOCATORS, max_size=8), st.sampled_from(BuiltinWriter), st.booleans())
def test_nothing_but_locators_changes(
    parameters: list[tuple[Pid, bytes]], writer: BuiltinWriter, little: bool
) -> None:
    """All other bytes stay, and all locators are replaced."""
    named = (Pid.TOPIC_NAME, struct.pack(order(little) + "I", 4) + b"rt/\0")
    before = message(data(payload([named, *parameters], little), writer=writer, little=little))
    after = rewritten(read_discovery(before), lambda pid, locator: HostPort(HOST, 45000), nothing)
    (announcement,) = read_discovery(before).announcements
    restored = bytearray(after)
    for parameter in announcement.parameters.all(*UNICAST, *MULTICAST):
        restored[parameter.offset : parameter.value.end] = before[
            parameter.offset : parameter.value.end
        ]
    assert bytes(restored) == before
    (changed,) = read_discovery(after).announcements
    assert {locator for _, locator in changed.reached_at(after)} <= {HostPort(HOST, 45000)}
    assert not changed.parameters.all(*MULTICAST)
