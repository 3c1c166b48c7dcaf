"""Parameter lists and the locators in them."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.net.addresses import HostPort
from rosproxy.ros2.protocol.locators import Locator, pack_locator, read_locator, replaced
from rosproxy.ros2.protocol.parameters import (
    ParameterList,
    Pid,
    inline_parameters,
    payload_parameters,
)
from rosproxy.ros2.protocol.rtps import MOST_PARAMETERS, RtpsError, Sample, apply, samples
from tests.unit.ros2.protocol.messages import data, message, order, parameter_list, payload

BOTH = pytest.mark.parametrize("little", [True, False], ids=["little", "big"])
ADDRESSES = st.one_of(st.ip_addresses(v=4), st.ip_addresses(v=6)).map(str)
PORTS = st.integers(1, 65535)
VALUES = st.binary(max_size=40).map(lambda value: value + bytes(-len(value) % 4))
LISTS = st.lists(st.tuples(st.integers(2, 0xFFFF), VALUES), max_size=10)


def read(datagram: bytes) -> tuple[Sample, ParameterList]:
    (sample,) = samples(datagram)
    held = payload_parameters(datagram, sample)
    assert held is not None
    return sample, held


@given(LISTS, st.booleans())
def test_a_list_is_read_as_it_was_written(held: list[tuple[int, bytes]], little: bool) -> None:
    datagram = message(data(payload(held, little), little=not little))
    _, found = read(datagram)
    assert found.little is little
    values = [(p.pid, datagram[p.value.start : p.value.end]) for p in found.parameters]
    assert values == held


@given(LISTS, ADDRESSES, PORTS, ADDRESSES, PORTS, st.booleans())
def test_a_locator_is_replaced_and_nothing_else(
    held: list[tuple[int, bytes]], before: str, port: int, host: str, lease: int, little: bool
) -> None:
    own = (Pid.METATRAFFIC_UNICAST_LOCATOR, pack_locator(HostPort(before, port), order(little)))
    others = [one for one in held if one[0] != own[0]]
    datagram = message(data(payload([*others, own, *others], little), little=little))
    _, found = read(datagram)
    (parameter,) = found.all(Pid.METATRAFFIC_UNICAST_LOCATOR)
    locator = read_locator(datagram, found, parameter)
    assert locator is not None
    assert locator.host_port == HostPort(before, port)
    changed = apply(datagram, [replaced(found, parameter, HostPort(host, lease))])
    span = parameter.value
    assert changed[: span.start] + changed[span.end :] == (
        datagram[: span.start] + datagram[span.end :]
    )
    after = read_locator(changed, read(changed)[1], parameter)
    assert after is not None
    assert after.host_port == HostPort(host, lease)


@BOTH
def test_a_parameter_that_is_taken_out_is_skipped_by_all(little: bool) -> None:
    shared_memory = struct.pack(order(little) + "iI", 16, 7411) + bytes(16)
    held = [(0x31, shared_memory), (0x02, bytes(8))]
    datagram = message(data(payload(held, little), little=little))
    _, found = read(datagram)
    changed = apply(datagram, [found.removed(found.all(0x31)[0])])
    assert [one.pid for one in read(changed)[1].parameters] == [Pid.PAD, 0x02]
    assert len(changed) == len(datagram)


@BOTH
def test_numbers_and_texts(little: bool) -> None:
    name = b"rt/chatter\0"
    text = struct.pack(order(little) + "I", len(name)) + name + b"\0"
    number = struct.pack(order(little) + "I", 42)
    datagram = message(data(payload([(0x0F, number), (0x05, text), (0x07, b"")], little)))
    _, found = read(datagram)
    assert found.number(datagram, Pid.DOMAIN_ID) == 42
    assert found.text(datagram, Pid.TOPIC_NAME) == "rt/chatter"
    assert found.number(datagram, Pid.TYPE_NAME) is None
    assert found.text(datagram, Pid.TYPE_NAME) is None
    assert found.text(datagram, Pid.ENTITY_NAME) is None


def test_a_text_that_leads_outside_is_none() -> None:
    datagram = message(data(payload([(0x05, struct.pack("<I", 100) + b"abcd")])))
    assert read(datagram)[1].text(datagram, Pid.TOPIC_NAME) is None


@BOTH
def test_inline_qos_has_the_byte_order_of_its_submessage(little: bool) -> None:
    qos = parameter_list([(0x71, b"\0\0\0\1")], little)
    datagram = message(data(payload([], not little), qos=qos, little=little))
    (sample,) = samples(datagram)
    found = inline_parameters(datagram, sample)
    assert found is not None
    assert [one.pid for one in found.parameters] == [Pid.STATUS_INFO]
    (plain,) = samples(message(data(b"abcd")))
    assert inline_parameters(message(data(b"abcd")), plain) is None


@pytest.mark.parametrize("content", [b"", b"\0\3", b"\0\1\0\0abcd", b"\0\7\0\0"])
def test_a_payload_that_is_no_list(content: bytes) -> None:
    datagram = message(data(content))
    (sample,) = samples(datagram)
    assert payload_parameters(datagram, sample) is None


@pytest.mark.parametrize(
    "content",
    [
        b"\0\3\0\0",
        b"\0\3\0\0\x50\0\x10\0abcd",
        b"\0\3\0\0\x50\0\x04\0abcd",
        b"\0\3\0\0" + b"\2\0\0\0" * MOST_PARAMETERS + b"\1\0\0\0",
    ],
)
def test_a_list_that_leads_outside_is_refused(content: bytes) -> None:
    datagram = message(data(content))
    (sample,) = samples(datagram)
    with pytest.raises(RtpsError):
        payload_parameters(datagram, sample)


@given(st.binary(max_size=300), st.booleans())
def test_any_payload_is_read_or_refused(content: bytes, little: bool) -> None:
    datagram = message(data(bytes([0, 3 if little else 2, 0, 0]) + content, little=little))
    (sample,) = samples(datagram)
    try:
        found = payload_parameters(datagram, sample)
    except RtpsError:
        return
    assert found is not None
    for one in found.parameters:
        assert sample.payload is not None
        assert sample.payload.start <= one.offset < one.value.end <= sample.payload.end
        read_locator(datagram, found, one)
        found.text(datagram, one.pid)


@pytest.mark.parametrize(
    ("locator", "where"),
    [
        (Locator(1, 7410, bytes(12) + b"\x0a\0\0\5"), HostPort("10.0.0.5", 7410)),
        (Locator(2, 7411, b"\xfd" + bytes(14) + b"\1"), HostPort("fd00::1", 7411)),
        (Locator(16, 7411, bytes(16)), None),
        (Locator(4, 7411, bytes(16)), None),
        (Locator(-1, 0, bytes(16)), None),
        (Locator(1, 0, bytes(12) + b"\x0a\0\0\5"), None),
        (Locator(1, 65536, bytes(12) + b"\x0a\0\0\5"), None),
    ],
)
def test_where_a_locator_leads(locator: Locator, where: HostPort | None) -> None:
    assert locator.host_port == where


def test_a_locator_that_is_too_short() -> None:
    datagram = message(data(payload([(0x31, bytes(20))])))
    _, found = read(datagram)
    assert read_locator(datagram, found, found.parameters[0]) is None


def test_a_name_is_no_locator() -> None:
    with pytest.raises(ValueError, match="robot"):
        pack_locator(HostPort("robot", 7410), "<")
