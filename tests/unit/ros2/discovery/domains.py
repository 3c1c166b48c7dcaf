"""A domain for tests, and datagrams of participants."""

import struct
from collections.abc import Iterable, Sequence
from ipaddress import ip_address, ip_network
from itertools import product

from rosproxy.ros2.discovery.domain import Domain
from rosproxy.ros2.domain_settings import DomainSettings, Judge, LanRelayLink, Outgoing
from rosproxy.ros2.ports.locator_ports import EVIDENCE_PERIOD_S
from rosproxy.ros2.ports.store import HALF_BITS, WRITERS, halves
from rosproxy.ros2.protocol.locators import pack_locator
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.protocol.relay_envelope import wrapped
from rosproxy.ros2.protocol.relay_proof import Direction, RelayProof
from rosproxy.ros2.protocol.rtps import HEADER_BYTES, source_prefix
from rosproxy.ros2.rewriting.discovery import BuiltinWriter, read_discovery
from rosproxy.ros2.sources.rates import BURST
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortMap, PortPool, PortRange
from tests.unit.ros2.protocol.messages import data, message, parameter_list, payload, submessage

INSIDE = "172.30.0.5"
OTHER = "172.30.0.6"
NEAR = "172.30.0.2"
HOST = "10.0.0.1"
ROBOT = "10.0.0.9"
STRANGER = "10.0.0.66"
LAN_RELAY = HostPort("172.30.0.1", 7500)
A = b"\x01\x0f" + bytes(10)
B = b"\x01\x0f" + bytes(range(10))
NETWORK = ip_network("172.30.0.0/24")
SECRET = "a secret of both"
UNIX_TIME = 1.7e9
PROOF = RelayProof(SECRET, lambda: UNIX_TIME)
RANGE = PortMap(PortRange(45000, 45015), PortRange(46000, 46015))
NOW = EVIDENCE_PERIOD_S + 1
SEDP_WRITERS = 0x000003C2
CYCLONE_DDS = b"\x01\x10"


def everything(*_: object) -> bool:
    return True


def make_domain(
    peers: Sequence[str] = (ROBOT,),
    lan_relay: HostPort | None = LAN_RELAY,
    judge: Judge = everything,
    both_ways: bool = False,
    ports: PortMap = RANGE,
    port_store_key: bytes = b"",
) -> Domain:
    settings = DomainSettings(
        number=0,
        hosts=(HOST,),
        ports=ports,
        proxy_address_for=lambda _: NEAR,
        note=lambda *_: None,
        judge=judge,
        is_inside=lambda address: ip_address(address) in NETWORK,
        both_ways=both_ways,
        peers=tuple(HostPort(peer, 7410) for peer in peers),
        relay=LanRelayLink(lan_relay, PROOF) if lan_relay else None,
        port_store_key=port_store_key,
    )
    return Domain(settings, PortPool(ports.listen), b"of the proxy", b"a secret", 0.0)


def spdp(
    prefix: bytes,
    address: str,
    port: int = 7410,
    lease: float = 20,
    padding: int = 0,
    data_port: int = 0,
) -> bytes:
    """An announcement. By default the port for user data follows that for discovery."""
    data_port = data_port or port + 1
    parameters = [
        (Pid.PARTICIPANT_GUID, prefix + bytes([0, 0, 1, 0xC1])),
        (Pid.METATRAFFIC_UNICAST_LOCATOR, pack_locator(HostPort(address, port), "<")),
        (Pid.DEFAULT_UNICAST_LOCATOR, pack_locator(HostPort(address, data_port), "<")),
        (Pid.PARTICIPANT_LEASE_DURATION, struct.pack("<iI", int(lease), 0)),
        *([(Pid.ENTITY_NAME, bytes(padding))] if padding else []),
    ]
    return message(data(payload(parameters)), prefix=prefix)


def of_vendor(datagram: bytes, vendor: bytes = CYCLONE_DDS) -> bytes:
    """A message of another implementation than Fast DDS."""
    return datagram[:6] + vendor + datagram[8:]


def carried(source: str, datagram: bytes) -> bytes:
    """The LAN relay's message to the proxy for a datagram from an address."""
    return PROOF.sealed(Direction.TO_PROXY, wrapped(source, datagram))


def dispose_message(prefix: bytes) -> bytes:
    qos = parameter_list([(Pid.STATUS_INFO, bytes([0, 0, 0, 3]))])
    return message(data(qos=qos), prefix=prefix)


def sedp(prefix: bytes, address: str, port: int, to: bytes = b"") -> bytes:
    parameters = [
        (Pid.ENDPOINT_GUID, prefix + bytes([0, 0, 1, 3])),
        (Pid.TOPIC_NAME, struct.pack("<I", 11) + b"rt/chatter\0\0"),
        (Pid.TYPE_NAME, struct.pack("<I", 4) + b"Str\0"),
        (Pid.UNICAST_LOCATOR, pack_locator(HostPort(address, port), "<")),
    ]
    meant = [submessage(0x0E, 0, to)] if to else []
    return message(*meant, data(payload(parameters), writer=SEDP_WRITERS), prefix=prefix)


def next_number(announcement: bytes) -> int:
    """The sequence number after that of a participant's announcement."""
    told = read_discovery(announcement).of_participant
    assert told is not None
    return told.sample.sequence + 1


def reached_at(datagram: bytes) -> list[HostPort]:
    (announcement,) = read_discovery(datagram).announcements
    return [locator for _, locator in announcement.reached_at(datagram)]


def kept_number(
    port_store: bytes, prefix: bytes, number: int, writer: int = BuiltinWriter.PUBLICATIONS
) -> bytes:
    """A participant's answer to a writer, with the next expected number."""
    body = struct.pack(">II", writer + 5, writer)
    body += struct.pack("<iIIi", number >> 32, number & 0xFFFFFFFF, 0, 1)
    return message(submessage(0x0E, 0, port_store), submessage(0x06, 2, body), prefix=prefix)


def kept_halves(own: bytes, prefix: bytes, number: int, bits: int) -> bytes:
    """A participant's answer to both writers of the port store, or of the port proof."""
    pairs = zip(WRITERS, halves(number, bits), strict=True)
    lower, upper = (kept_number(own, prefix, half, writer) for writer, half in pairs)
    return lower + upper[HEADER_BYTES:]


def kept_answer(domain: Domain, prefix: bytes, number: int) -> bytes:
    """A participant's answer to the port store of a domain."""
    port_store = domain.proxy_participants.port_store
    return kept_halves(port_store.prefix, prefix, number, port_store.lower_half_bits)


def proof_answer(domain: Domain, prefix: bytes, proof: int) -> bytes:
    """A participant's answer to the port proof of a domain with a secret."""
    return kept_halves(domain.proxy_participants.port_store.proof_prefix, prefix, proof, HALF_BITS)


def allowance_left(domain: Domain, source: str) -> float:
    allowance = domain.rates._by_source.get(source)
    return allowance.remaining if allowance else BURST


def prove(domain: Domain, *addresses: str, prefixes: Iterable[bytes] = (A,)) -> None:
    """Have participants at addresses answer the questions that are for these addresses alone."""
    for address, prefix in product(addresses, prefixes):
        asked = domain.proofs.question(address, prefix, [HostPort(NEAR, 7410)])
        answer = message(submessage(0x0E, 0, source_prefix(asked)), prefix=prefix)
        assert domain.proofs.note(address, answer, NOW)


def meet(domain: Domain, prefix: bytes = A, address: str = INSIDE) -> list[Outgoing]:
    return domain.heard_inside(spdp(prefix, address), address, NOW)


def finished(domain: Domain, sent: Sequence[Outgoing], now: float = NOW) -> list[Outgoing]:
    """All datagrams of a change, beginning with ``sent``."""
    every = list(sent)
    while domain.is_busy:
        every += domain.go_on(now)
    return every


def settle(domain: Domain, now: float) -> list[Outgoing]:
    """Admit participants that waited long enough, and end their separations."""
    admitted = [out for p in domain.former_ports.ready(now) for out in domain.admit(p, now)]
    return admitted + finished(domain, domain.continue_pending(now), now)


def to(outgoing: Sequence[Outgoing], host: str) -> list[bytes]:
    """The datagrams to a host. Datagrams to the LAN relay are unwrapped."""
    return [
        PROOF.opened(Direction.TO_LAN, sent.datagram) if sent.target == LAN_RELAY else sent.datagram
        for sent in outgoing
        if sent.target.host == host
    ]
