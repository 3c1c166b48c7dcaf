"""Parameter lists, and locators in parameter lists."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.ros2.protocol.locators import Locator, pack_locator, read_locator, replaced
from rosproxy.ros2.protocol.parameters import (
    ParameterList,
    Pid,
    inline_parameters,
    payload_parameters,
)
from rosproxy.ros2.protocol.rtps import MOST_PARAMETERS, RtpsError, Sample, apply, samples
from rosproxy.shared.addresses import HostPort
from tests.unit.ros2.protocol.messages import VALUES, data, message, order, parameter_list, payload

BOTH = pytest.mark.parametrize("little", [True, False], ids=["little", "big"])
ADDRESSES = st.one_of(st.ip_addresses(v=4), st.ip_addresses(v=6)).map(str)
PORTS = st.integers(1, 65535)
LISTS = st.lists(st.tuples(st.integers(2, 0xFFFF), VALUES), max_size=10)


def read(datagram: bytes) -> tuple[Sample, ParameterList]:
    (sample,) = samples(datagram)
    parsed = payload_parameters(datagram, sample)
    assert parsed is not None
    return sample, parsed


@given(LISTS, st.booleans())
def test_a_list_is_read_as_it_was_written(
    parameters: list[tuple[int, bytes]], little: bool
) -> None:
    datagram = message(data(payload(parameters, little), little=not little))
    _, parsed = read(datagram)
    assert parsed.is_little_endian is little
    values = [(p.pid, datagram[p.value.start : p.value.end]) for p in parsed.parameters]
    assert values == parameters


@given(LISTS, ADDRESSES, PORTS, ADDRESSES, PORTS, st.booleans())
def test_a_locator_is_replaced_and_nothing_else(
    parameters: list[tuple[int, bytes]], before: str, port: int, host: str, lease: int, little: bool
) -> None:
    own = (Pid.METATRAFFIC_UNICAST_LOCATOR, pack_locator(HostPort(before, port), order(little)))
    other_parameters = [parameter for parameter in parameters if parameter[0] != own[0]]
    datagram = message(
        data(payload([*other_parameters, own, *other_parameters], little), little=little)
    )
    _, parsed = read(datagram)
    (parameter,) = parsed.all(Pid.METATRAFFIC_UNICAST_LOCATOR)
    locator = read_locator(datagram, parsed, parameter)
    assert locator is not None
    assert locator.host_port == HostPort(before, port)
    changed = apply(datagram, [replaced(parsed, parameter, HostPort(host, lease))])
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
    parameters = [(0x31, shared_memory), (0x02, bytes(8))]
    datagram = message(data(payload(parameters, little), little=little))
    _, parsed = read(datagram)
    changed = apply(datagram, [parsed.removed(parsed.all(0x31)[0])])
    assert [parameter.pid for parameter in read(changed)[1].parameters] == [Pid.PAD, 0x02]
    assert len(changed) == len(datagram)


@BOTH
def test_numbers_and_texts(little: bool) -> None:
    name = b"rt/chatter\0"
    text = struct.pack(order(little) + "I", len(name)) + name + b"\0"
    number = struct.pack(order(little) + "I", 42)
    datagram = message(data(payload([(0x0F, number), (0x05, text), (0x07, b"")], little)))
    _, parsed = read(datagram)
    assert parsed.number(datagram, Pid.DOMAIN_ID) == 42
    assert parsed.text(datagram, Pid.TOPIC_NAME) == "rt/chatter"
    assert parsed.number(datagram, Pid.TYPE_NAME) is None
    assert parsed.text(datagram, Pid.TYPE_NAME) is None
    assert parsed.text(datagram, Pid.ENTITY_NAME) is None


def test_a_text_that_leads_outside_is_none() -> None:
    datagram = message(data(payload([(0x05, struct.pack("<I", 100) + b"abcd")])))
    assert read(datagram)[1].text(datagram, Pid.TOPIC_NAME) is None


@BOTH
def test_inline_qos_has_the_byte_order_of_its_submessage(little: bool) -> None:
    qos = parameter_list([(0x71, b"\0\0\0\1")], little)
    datagram = message(data(payload([], not little), qos=qos, little=little))
    (sample,) = samples(datagram)
    parsed = inline_parameters(datagram, sample)
    assert parsed is not None
    assert [parameter.pid for parameter in parsed.parameters] == [Pid.STATUS_INFO]
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
        b"\0\3\0\0\x50\0\x03\0abc\1\0\0\0",
        b"\0\3\0\0\x50\0\x03\0abc\0\1\0\0\0",
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
        parsed = payload_parameters(datagram, sample)
    except RtpsError:
        return
    assert parsed is not None
    for parameter in parsed.parameters:
        assert sample.payload is not None
        assert sample.payload.start <= parameter.offset < parameter.value.end <= sample.payload.end
        read_locator(datagram, parsed, parameter)
        parsed.text(datagram, parameter.pid)


@pytest.mark.parametrize(
    ("locator", "host_port"),
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
def test_where_a_locator_leads(locator: Locator, host_port: HostPort | None) -> None:
    assert locator.host_port == host_port


def test_a_locator_that_is_too_short() -> None:
    datagram = message(data(payload([(0x31, bytes(20))])))
    _, parsed = read(datagram)
    assert read_locator(datagram, parsed, parsed.parameters[0]) is None


def test_a_name_is_no_locator() -> None:
    with pytest.raises(ValueError, match="robot"):
        pack_locator(HostPort("robot", 7410), "<")
