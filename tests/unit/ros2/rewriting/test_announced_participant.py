"""Parts of an announcement that may keep other participants from discovering the participant."""

import struct
from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.ros2.protocol.locators import pack_locator
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.registry.participants import DdsSecurity, LocatorFault, ParticipantTraits
from rosproxy.ros2.rewriting.announced_participant import traits
from rosproxy.ros2.rewriting.discovery import read_discovery
from rosproxy.shared.addresses import HostPort
from tests.unit.ros2.protocol.messages import VALUES, data, message, payload

INSIDE = "172.30.0.5"
OTHER = "172.30.0.6"
LARGE_DATA = bytes.fromhex(
    "525450530202010f010f3d110557fad8000000000901080058e3036b3c4ce3961505940100001000000100c7"
    "000100c2000000000100000000030000150004000202000016000400010f000050001000010f3d110557fad8"
    "00000000000001c107800400050000003200180004000000afa8f21c0000000000000000000000000a090001"
    "3100180010000000f31c0000553d11000000000000000000000000003100180004000000afa8f31c00000000"
    "00000000000000000a090001020008001400000000000000580004003f0c000062000800020000002f000000"
    "2c0010000b000000656e636c6176653d2f3b00005900c00004000000110000005041525449434950414e545f"
    "54595045000000000700000053494d504c4500001b000000666173746464732e706879736963616c5f646174"
    "612e686f7374000018000000766d3a3137343235313738303037323839393231353336001b00000066617374"
    "6464732e706879736963616c5f646174612e75736572000005000000726f6f74000000001e00000066617374"
    "6464732e706879736963616c5f646174612e70726f6365737300000006000000323232373700000001000000"
    "8001380001000000e81c0000000000000000000000000000efff000158e3036b60fee3960100000000000000"
    "f4010000000000000000000000000000"
)
"""An announcement of Fast DDS 2.14 (Jazzy) at 10.9.0.1 with
FASTDDS_BUILTIN_TRANSPORTS=LARGE_DATA.
"""

SECURED = bytes.fromhex(
    "5254505302010110ecbaf160345e80d6580d4475090108005ee9036bd6f4c4771505dc010000100000000000"
    "000100c20000000001000000000300002c00180012000000444453506572663a303a33303639363a766d0000"
    "59005800030000000e0000005f5f50726f636573734e616d6500000008000000646473706572660006000000"
    "5f5f5069640000000600000033303639360000000b0000005f5f486f73746e616d65000003000000766d0000"
    "0000000015000400020100001600040001100000020008000a0000000000000050001000ecbaf160345e80d6"
    "580d4475000001c1580004003ffcff0f05100800070000800600008001102000140000004444533a41757468"
    "3a504b492d44483a312e30000000000000000000021028001b0000004444533a4163636573733a5065726d69"
    "7373696f6e733a312e30000000000000000000000f000400000000003100180001000000bad5000000000000"
    "00000000000000000a0900014800180001000000e91c0000000000000000000000000000efff000132001800"
    "01000000bad500000000000000000000000000000a0900013300180001000000e81c00000000000000000000"
    "00000000efff000107803000000000002c00000000000000000000000000000016000000766d2f302e31302e"
    "322f4c696e75782f4c696e7578000000198004000000200001000000"
)
"""An announcement of Cyclone DDS 0.10 (Debian) at 10.9.0.1 with DDS Security: discovery is
encrypted, messages are signed.
"""
READABLE = SECURED.replace(bytes.fromhex("0510080007000080"), bytes.fromhex("0510080000000080"))
"""The same with a governance that protects neither; as seen."""


def said(datagram: bytes, address: str) -> ParticipantTraits:
    told = read_discovery(datagram).of_participant
    assert told is not None
    return traits(told, datagram, address)


def spdp(parameters: Sequence[tuple[int, bytes]]) -> bytes:
    return message(data(payload(parameters)))


def udp(address: str, pid: int = Pid.METATRAFFIC_UNICAST_LOCATOR) -> tuple[int, bytes]:
    return pid, pack_locator(HostPort(address, 7410), "<")


def of_kind(kind: int, pid: int = Pid.METATRAFFIC_UNICAST_LOCATOR) -> tuple[int, bytes]:
    return pid, struct.pack("<iI", kind, 7410) + bytes(16)


def test_a_real_one_that_has_tcp_alone() -> None:
    assert said(LARGE_DATA, "10.9.0.1") == ParticipantTraits(locator_fault=LocatorFault.TCP)


def test_real_ones_with_dds_security() -> None:
    assert said(SECURED, "10.9.0.1") == ParticipantTraits(0, DdsSecurity.PROTECTED)
    assert READABLE != SECURED
    assert said(READABLE, "10.9.0.1") == ParticipantTraits(0, DdsSecurity.AUTHENTICATED)


@pytest.mark.parametrize(
    ("parameters", "fault"),
    [
        ([udp(INSIDE)], LocatorFault.NO),
        ([udp("127.0.0.1"), udp(INSIDE), of_kind(4)], LocatorFault.NO),
        ([udp("127.0.0.1")], LocatorFault.LOOPBACK),
        ([udp("127.0.0.1"), udp(OTHER)], LocatorFault.ELSEWHERE),
        ([of_kind(8), of_kind(16)], LocatorFault.TCP),
        ([of_kind(16)], LocatorFault.MISSING),
        ([], LocatorFault.MISSING),
        ([udp(INSIDE), udp(INSIDE, Pid.DEFAULT_UNICAST_LOCATOR)], LocatorFault.NO),
        ([udp(INSIDE), of_kind(4, Pid.DEFAULT_UNICAST_LOCATOR)], LocatorFault.TCP),
        ([udp(INSIDE), udp(OTHER, Pid.DEFAULT_UNICAST_LOCATOR)], LocatorFault.ELSEWHERE),
        ([(Pid.METATRAFFIC_UNICAST_LOCATOR, bytes(8))], LocatorFault.MISSING),
    ],
)
def test_where_it_can_be_reached(parameters: list[tuple[int, bytes]], fault: LocatorFault) -> None:
    assert said(spdp(parameters), INSIDE).locator_fault is fault


def info(attributes: int) -> tuple[int, bytes]:
    return Pid.PARTICIPANT_SECURITY_INFO, struct.pack("<II", attributes, 0x80000000)


TOKEN = Pid.IDENTITY_TOKEN, struct.pack("<I", 20) + b"DDS:Auth:PKI-DH:1.0\0" + bytes(8)


@pytest.mark.parametrize(
    ("parameters", "security"),
    [
        ([], DdsSecurity.NONE),
        ([TOKEN], DdsSecurity.AUTHENTICATED),
        ([TOKEN, info(0x80000000)], DdsSecurity.AUTHENTICATED),
        ([TOKEN, info(0x80000004)], DdsSecurity.AUTHENTICATED),
        ([TOKEN, info(0x80000001)], DdsSecurity.PROTECTED),
        ([TOKEN, info(0x80000002)], DdsSecurity.PROTECTED),
        ([TOKEN, info(0x80000007)], DdsSecurity.PROTECTED),
        ([TOKEN, info(0x00000003)], DdsSecurity.AUTHENTICATED),
        ([info(0)], DdsSecurity.NONE),
    ],
)
def test_what_it_says_of_dds_security(
    parameters: list[tuple[int, bytes]], security: DdsSecurity
) -> None:
    assert said(spdp([*parameters, udp(INSIDE)]), INSIDE).security is security


@pytest.mark.parametrize(("number", "domain"), [(0, 0), (7, 7), (2**32 - 1, None)])
def test_its_domain(number: int, domain: int | None) -> None:
    parameters = [udp(INSIDE), (Pid.DOMAIN_ID, struct.pack("<I", number))]
    assert said(spdp(parameters), INSIDE).domain == domain
    assert said(spdp([udp(INSIDE)]), INSIDE).domain is None


@given(
    st.lists(
        st.tuples(st.sampled_from([0x31, 0x32, 0x0F, 0x1001, 0x1002, 0x1005]), VALUES),
        max_size=12,
    )
)
def test_whatever_it_says_is_read(parameters: list[tuple[int, bytes]]) -> None:
    said(spdp(parameters), INSIDE)
