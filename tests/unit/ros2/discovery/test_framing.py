"""Datagrams that two implementations read differently: none passes a policy."""

import struct
from collections.abc import Iterator

import pytest

from rosproxy.ros2.discovery.domain import Domain
from rosproxy.ros2.domain_settings import Outgoing
from rosproxy.ros2.protocol.parameters import Pid
from tests.unit.ros2.discovery.domains import (
    INSIDE,
    NOW,
    ROBOT,
    SEDP_WRITERS,
    A,
    B,
    make_domain,
    meet,
    spdp,
)
from tests.unit.ros2.protocol.messages import (
    data,
    message,
    order,
    parameter,
    parameter_list,
    submessage,
)


def topic(name: str, little: bool = True) -> bytes:
    text = struct.pack(order(little) + "I", len(name) + 1) + name.encode() + b"\0"
    return parameter(Pid.TOPIC_NAME, text + bytes(-len(text) % 4), little)


def denying() -> Domain:
    domain = make_domain(judge=lambda _kind, name, _address: name != "/secret")
    meet(domain)
    domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    return domain


def metatraffic(domain: Domain) -> int:
    (port,) = [port for port, (_, le) in domain.mappings.by_port.items() if le.target.port == 7410]
    return port


def crossing(domain: Domain, submessages: bytes) -> Iterator[list[Outgoing]]:
    """The datagrams that the proxy forwards for a message from inside, then from outside."""
    (stand_in,) = domain.stand_ins.by_port
    yield domain.at_stand_in(stand_in, message(submessages, prefix=A), INSIDE, NOW)
    yield domain.at_range_port(metatraffic(domain), message(submessages, prefix=B), ROBOT, NOW)


def announced(parameters: bytes, little: bool = True) -> bytes:
    encoding = bytes([0, 3 if little else 2, 0, 0])
    return data(encoding + parameters, writer=SEDP_WRITERS, little=little)


def behind_an_unaligned_parameter() -> bytes:
    """Without rounding up, three bytes begin a parameter that ends before the allowed topic."""
    denied = topic("rt/secret", False)
    allowed = topic("rt/public", False)
    end = parameter(1, b"", False)
    one_byte = struct.pack(">HHB", 0x8000, 1, 0)
    unknown = struct.pack(">HH", 0x8000, 256)
    assert unknown[3:] == denied[:1]
    before = bytes(256 - len(denied[1:]) - 4)
    told = parameter(0x8000, before + allowed + end + bytes(3), False)
    return announced(one_byte + unknown[:3] + denied + told + end, False)


def behind_an_unaligned_submessage() -> bytes:
    """Without rounding up, three bytes begin an unknown submessage that spans the rest."""
    denied = topic("rt/secret") + parameter(1, b"")
    filler = parameter(0x8000, bytes(0x114 - len(announced(denied)) - 4))
    hidden = announced(filler + denied + b"\0\0")
    unknown = struct.pack(">BBH", 0x80, 0, len(hidden) - 1)
    assert unknown[3:] == hidden[:1]
    return submessage(0x01, 0, b"\0") + unknown[:3] + hidden


@pytest.mark.parametrize(
    "hidden", [behind_an_unaligned_parameter(), behind_an_unaligned_submessage()]
)
def test_what_is_behind_an_unaligned_length_is_not_passed(hidden: bytes) -> None:
    """Fast DDS rounds lengths up and reads the denied topic. The proxy must not read another."""
    domain = denying()
    for count, sent in enumerate(crossing(domain, hidden), 1):
        assert sent == []
        assert domain.refused.count == count


def ends(*statuses: int) -> bytes:
    told = [(Pid.STATUS_INFO, bytes([0, 0, 0, status])) for status in statuses]
    return data(SECRET, qos=parameter_list(told), writer=SEDP_WRITERS)


SECRET = bytes([0, 3, 0, 0]) + topic("rt/secret") + parameter(1, b"")
AS_KEY_AND_AS_DATA = submessage(0x15, 0x0C, data(SECRET, writer=SEDP_WRITERS)[4:])


@pytest.mark.parametrize("said", [ends(3, 0), ends(3), AS_KEY_AND_AS_DATA])
def test_what_one_takes_for_an_end_and_another_does_not_is_judged(said: bytes) -> None:
    """Cyclone DDS reads the last status of several; the proxy read the first, and judged no end."""
    for sent in crossing(denying(), said):
        assert b"secret" not in sent[-1].datagram


@pytest.mark.parametrize("size", [1, 2, 3, 5])
def test_an_unaligned_submessage_may_be_the_last(size: int) -> None:
    said = announced(topic("rt/public") + parameter(1, b"")) + submessage(0x80, 0, bytes(size))
    for sent in crossing(denying(), said):
        assert sent[-1].datagram.endswith(bytes(size))
        assert b"rt/public" in sent[-1].datagram


def text_topic(size: int, text: bytes) -> bytes:
    value = struct.pack("<I", size) + text
    return parameter(Pid.TOPIC_NAME, value + bytes(-len(value) % 4))


WITHOUT_END = text_topic(4, b"rt/secret")
"""Fast DDS reads a topic up to a zero byte, and ignores the length (CDRMessage.hpp, readString)."""
BEYOND = text_topic(200, b"rt/secret") + parameter(0x8000, bytes(200))
"""Fast DDS checks the length against the message alone."""
TOO_LONG = text_topic(258, b"rt/" + b"a" * 254)
"""Fast DDS cuts a topic after 255 bytes, or refuses the topic (fixed_size_string.hpp)."""


@pytest.mark.parametrize("statuses", [(), (3,)])
@pytest.mark.parametrize("name", [WITHOUT_END, BEYOND, TOO_LONG])
def test_a_topic_that_two_read_differently_is_not_passed(
    name: bytes, statuses: tuple[int, ...]
) -> None:
    domain = denying()
    told = [(Pid.STATUS_INFO, bytes([0, 0, 0, status])) for status in statuses]
    qos = parameter_list(told) if told else b""
    content = bytes([0, 3, 0, 0]) + name + parameter(1, b"")
    for count, sent in enumerate(crossing(domain, data(content, qos=qos, writer=SEDP_WRITERS)), 1):
        assert sent == []
        assert domain.refused.count == count


def test_the_longest_topic_of_fast_dds_passes() -> None:
    name = b"rt/" + b"a" * 252
    said = announced(text_topic(256, name) + parameter(1, b""))
    for sent in crossing(denying(), said):
        assert name in sent[-1].datagram
