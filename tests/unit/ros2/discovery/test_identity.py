"""The subject of an announcement: no participant announces or ends another."""

from collections.abc import Iterator

import pytest

from rosproxy.ros2.discovery.domain import Domain
from rosproxy.ros2.domain_settings import Outgoing
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.protocol.rtps import source_prefix
from rosproxy.ros2.rewriting.discovery import BuiltinWriter
from tests.unit.ros2.discovery.domains import (
    INSIDE,
    LAN_RELAY,
    NOW,
    OTHER,
    ROBOT,
    A,
    B,
    carried,
    dispose_message,
    make_domain,
    meet,
    spdp,
    to,
)
from tests.unit.ros2.protocol.messages import data, fragment, message, parameter_list, payload

C = b"\x01\x0f" + bytes(9) + b"\x07"
IDENTITIES = [Pid.PARTICIPANT_GUID, Pid.ENDPOINT_GUID, Pid.KEY_HASH]
ENDED = (Pid.STATUS_INFO, bytes([0, 0, 0, 3]))
TOPIC = (Pid.TOPIC_NAME, b"\x0b\0\0\0rt/chatter\0\0")
ENTITY = bytes([0, 0, 1, 3])


def met() -> Domain:
    """A and C are inside, B is outside."""
    domain = make_domain()
    meet(domain)
    meet(domain, C, OTHER)
    domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    return domain


def crossing(domain: Domain, said: bytes) -> Iterator[list[Outgoing]]:
    """The forwarded datagrams of a message from A inside and from B outside, for each way."""
    (stand_in,) = domain.stand_ins.by_port
    (mapping,) = [
        le for le in domain.inside.by_prefix[A].mappings.values() if le.target.port == 7410
    ]
    inside = message(said, prefix=A)
    outside = message(said, prefix=B)
    yield domain.at_stand_in(stand_in, inside, INSIDE, NOW)
    yield domain.heard_inside(inside, INSIDE, NOW)
    yield domain.at_range_port(mapping.port, outside, ROBOT, NOW)
    yield domain.heard_outside(outside, ROBOT, NOW)
    yield domain.heard_outside(carried(ROBOT, outside), LAN_RELAY.host, NOW)


@pytest.mark.parametrize("whose", ["discovery-participant", "port-store", "port-proof"])
def test_no_participant_has_a_prefix_of_the_proxy(whose: str) -> None:
    """A forged dispose message of the port store would make participants inside forget
    their ports.
    """
    domain = make_domain(port_store_key=b"a key")
    meet(domain)
    port_store = domain.proxy_participants.port_store
    own = {
        "discovery-participant": domain.proxy_participants.discovery_participant.prefix,
        "port-store": port_store.prefix,
        "port-proof": port_store.proof_prefix,
    }
    prefix = own[whose]
    (port,) = [
        p for p, (_, mapping) in domain.mappings.by_port.items() if mapping.target.port == 7410
    ]
    sent = list[Outgoing]()
    for said in (spdp(prefix, ROBOT), dispose_message(prefix)):
        sent += domain.heard_outside(said, ROBOT, NOW)
        sent += domain.heard_outside(carried(ROBOT, said), LAN_RELAY.host, NOW)
        sent += domain.at_range_port(port, said, ROBOT, NOW)
    for said in (spdp(prefix, OTHER), dispose_message(prefix)):
        sent += domain.heard_inside(said, OTHER, NOW)
    assert prefix not in {source_prefix(datagram) for datagram in to(sent, INSIDE)}
    assert prefix not in {source_prefix(datagram) for datagram in to(sent, ROBOT)}


def said_of(prefix: bytes, pid: int, writer: int) -> dict[str, bytes]:
    """Announcements and dispose messages that name a participant in several ways."""
    named = (pid, prefix + ENTITY)
    key = parameter_list([named, ENDED])
    part = payload([TOPIC, (0x8000, bytes(200))])
    return {
        "announced": data(payload([named, TOPIC]), writer=writer),
        "announced, by the key": data(payload([TOPIC]), qos=parameter_list([named]), writer=writer),
        "announced twice": data(payload([(pid, A + ENTITY), named, TOPIC]), writer=writer),
        "ended": data(payload([named]), qos=parameter_list([ENDED]), writer=writer),
        "ended, by the key": data(qos=key, writer=writer),
        "ended, as a key alone": data(payload([named]), key=True, writer=writer),
        "ended in fragments": fragment(part, 1, 300, len(part), writer=writer, qos=key),
        "half a name": data(payload([(pid, prefix[:8]), TOPIC]), writer=writer),
    }


@pytest.mark.parametrize("how", said_of(C, Pid.KEY_HASH, BuiltinWriter.PARTICIPANTS))
@pytest.mark.parametrize("pid", IDENTITIES)
@pytest.mark.parametrize("writer", BuiltinWriter)
def test_no_participant_speaks_for_another_under_its_own_prefix(
    how: str, pid: int, writer: BuiltinWriter
) -> None:
    """Fast DDS ends or admits the participant in the parameter."""
    domain = met()
    for count, sent in enumerate(crossing(domain, said_of(C, pid, writer)[how]), 1):
        assert sent == []
        assert domain.refused.count == count
    assert domain.inside.by_prefix.keys() == {A, C}
    assert domain.outside.by_prefix.keys() == {B}


def test_nobody_is_ended_by_a_key_that_is_no_parameter_list() -> None:
    domain = met()
    raw = data(bytes([0, 1, 0, 0]) + C + ENTITY, key=True, writer=BuiltinWriter.PUBLICATIONS)
    for sent in crossing(domain, raw):
        assert sent == []


@pytest.mark.parametrize("how", said_of(A, Pid.KEY_HASH, BuiltinWriter.PUBLICATIONS))
@pytest.mark.parametrize("pid", IDENTITIES)
def test_everybody_speaks_for_himself(how: str, pid: int) -> None:
    domain = met()
    (stand_in,) = domain.stand_ins.by_port
    said = said_of(A, pid, BuiltinWriter.PUBLICATIONS)[how]
    sent = domain.at_stand_in(stand_in, message(said, prefix=A), INSIDE, NOW)
    assert bool(sent) is (how != "half a name")
