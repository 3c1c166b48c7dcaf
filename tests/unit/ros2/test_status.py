"""The status of a domain: topics, types, and readers and writers that do not match."""

import asyncio
import struct
from dataclasses import dataclass, field
from typing import cast

import pytest

from rosproxy.ros2.discovery.domain import Domain
from rosproxy.ros2.domain_plane import DomainPlane
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.registry.participants import (
    COMES_IN_WITHIN_S,
    DdsEndpoint,
    EndpointKind,
    Participant,
    PortMapping,
)
from rosproxy.ros2.servers.domain_server import DomainServer
from rosproxy.ros2.servers.receive_buffers import ReceiveBuffers
from rosproxy.ros2.status import MOST_STEPS_AT_ONCE, Ros2State, _first_endpoints
from rosproxy.shared.documents.status_document import (
    DataPlaneStatus,
    DomainStatus,
    LocatorStatus,
    NamedTypeStatus,
)
from rosproxy.shared.ports import PortMap, PortRange
from tests.unit.ros2.discovery import domains
from tests.unit.ros2.discovery.domains import (
    INSIDE,
    NOW,
    OTHER,
    ROBOT,
    A,
    B,
    make_domain,
    prove,
    spdp,
)
from tests.unit.ros2.protocol.messages import data, message, payload

PUBLICATIONS = 0x000003C2
SUBSCRIPTIONS = 0x000004C2


@dataclass
class Served:
    """The part of a server that the status needs."""

    domain: Domain
    lost: int = 0
    unselected: tuple[str, ...] = ()
    buffers: ReceiveBuffers = field(default_factory=ReceiveBuffers)


class Copied:
    """A plane by which the proxy forwards everything."""

    def status(self) -> DataPlaneStatus:
        return DataPlaneStatus()

    def locator(self, _: Participant, mapping: PortMapping) -> LocatorStatus:
        return LocatorStatus(mapping.port, rate=mapping.rate)


def text(value: str) -> bytes:
    raw = value.encode() + b"\0"
    return struct.pack("<I", len(raw)) + raw + bytes(-len(raw) % 4)


def sedp(prefix: bytes, writer: int, topic: str, kind: str, reliability: int) -> bytes:
    parameters = [
        (Pid.ENDPOINT_GUID, prefix + bytes([0, 0, len(topic), 3])),
        (Pid.TOPIC_NAME, text(topic)),
        (Pid.TYPE_NAME, text(kind)),
        (Pid.RELIABILITY, struct.pack("<IiI", reliability, 0, 0)),
    ]
    return message(data(payload(parameters), writer=writer), prefix=prefix)


def state_of(domain: Domain) -> Ros2State:
    return Ros2State([cast(DomainServer, Served(domain))], cast(DomainPlane, Copied()))


def told(domain: Domain) -> DomainStatus:
    (status,) = state_of(domain).status()
    return status


def announce(domain: Domain, reliability: int) -> None:
    """A publisher inside that is not reliable, a server there, and a subscriber outside."""
    domain.heard_inside(spdp(A, INSIDE), INSIDE, NOW)
    domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    (stand_in,) = domain.stand_ins.by_port
    string = "std_msgs::msg::dds_::String_"
    trigger = "std_srvs::srv::dds_::Trigger_Request_"
    for writer, topic, kind in (
        (PUBLICATIONS, "rt/scan", string),
        (SUBSCRIPTIONS, "rq/addRequest", trigger),
    ):
        domain.at_stand_in(stand_in, sedp(A, writer, topic, kind, 1), INSIDE, NOW)
    port = next(
        port
        for port, (_, mapping) in domain.mappings.by_port.items()
        if mapping.target.port == 7410
    )
    domain.at_range_port(port, sedp(B, SUBSCRIPTIONS, "rt/scan", string, reliability), ROBOT, NOW)


def test_topics_and_their_types() -> None:
    domain = make_domain()
    announce(domain, 1)
    (inside,) = told(domain).inside
    (outside,) = told(domain).outside
    assert (inside.publishes, inside.services, outside.subscribes) == (
        ("/scan",),
        ("/add",),
        ("/scan",),
    )
    assert inside.types == (
        NamedTypeStatus("/add", "std_srvs/srv/Trigger"),
        NamedTypeStatus("/scan", "std_msgs/msg/String"),
    )
    assert told(domain).mismatches == ()


async def test_a_long_comparison_is_made_in_steps_and_the_status_has_the_last_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A status took 0.3 s to compare 20,000 pairs. Meanwhile the proxy forwarded nothing."""
    monkeypatch.setattr("rosproxy.ros2.registry.matching.ITEMS_PER_STEP", 1)
    domain = make_domain()
    announce(domain, 2)
    state = state_of(domain)
    assert state.status()[0].mismatches == ()
    renewal = asyncio.create_task(state.comparisons.renew([domain]))
    for _ in range(MOST_STEPS_AT_ONCE):
        await asyncio.sleep(0)
    assert not renewal.done()
    await renewal
    assert [pair.policy for pair in state.status()[0].mismatches] == ["reliability"]


def test_a_participant_has_the_names_of_all_its_nodes(monkeypatch: pytest.MonkeyPatch) -> None:
    """If the status lists only one reader of the participant, this reader names a node."""
    domain = make_domain()
    announce(domain, 1)
    (stand_in,) = domain.stand_ins.by_port
    kind = "rcl_interfaces::srv::dds_::GetParameters_Request_"
    for node in ("driver", "arm/planner"):
        topic = f"rq/{node}/get_parametersRequest"
        domain.at_stand_in(stand_in, sedp(A, SUBSCRIPTIONS, topic, kind, 1), INSIDE, NOW)
    (inside,) = told(domain).inside
    assert inside.nodes == ("/arm/planner", "/driver")
    monkeypatch.setattr("rosproxy.ros2.status.MOST_LISTED_ENDPOINTS", 1)
    (inside,) = told(domain).inside
    assert (inside.nodes, inside.services) == (("/driver",), ("/driver/get_parameters",))
    graph = DdsEndpoint(EndpointKind.WRITER, "ros_discovery_info", "Graph", nodes=("/driver", "/x"))
    domain.inside.notes.note(domain.inside.by_prefix[A], b"\0\0\1\3", graph)
    monkeypatch.setattr("rosproxy.ros2.status.MOST_LISTED_ENDPOINTS", 3)
    (inside,) = told(domain).inside
    assert inside.nodes == ("/arm/planner", "/driver", "/x")


@pytest.mark.parametrize(("both_ways", "direction"), [(False, "out"), (True, "both")])
def test_in_which_direction_the_proxy_passes_on(both_ways: bool, direction: str) -> None:
    assert told(make_domain(both_ways=both_ways)).direction == direction


def test_what_there_is_too_little_of() -> None:
    ports = PortMap(PortRange(45000, 45099), PortRange(45000, 45099))
    domain = make_domain(ports=ports)
    domain.heard_inside(spdp(A, INSIDE), INSIDE, NOW)
    for number in range(20):
        domain.heard_inside(domains.sedp(A, INSIDE, 9000 + number), INSIDE, NOW)
    (inside,) = told(domain).inside
    assert (inside.shortage, len(inside.leases)) == ("bound", 16)
    assert "more than 16 locators" in inside.problem
    domain = make_domain()
    for number in range(1, 10):
        address = f"172.30.0.{number}"
        domain.heard_inside(spdp(number.to_bytes(12, "big"), address), address, NOW)
    assert {participant.shortage for participant in told(domain).inside} == {"", "range"}


def test_who_does_not_match() -> None:
    domain = make_domain()
    announce(domain, 2)
    (mismatch,) = told(domain).mismatches
    assert (mismatch.kind, mismatch.name, mismatch.policy) == ("topic", "/scan", "reliability")
    (inside,) = told(domain).inside
    (outside,) = told(domain).outside
    assert (mismatch.writer, mismatch.reader) == (inside.guid_prefix, outside.guid_prefix)


def test_the_rate_of_a_port() -> None:
    domain = make_domain()
    announce(domain, 1)
    (_, mapping), *_ = domain.mappings.by_port.values()
    mapping.update_rates(NOW)
    mapping.note_passed(1000, has_samples=False)
    for _ in range(4):
        mapping.note_passed(500, has_samples=True)
    mapping.update_rates(NOW + 2)
    (inside,) = told(domain).inside
    assert 1500.0 in {locator.rate for locator in inside.leases}
    assert (mapping.user_rate, mapping.user_datagram_rate) == (1000.0, 2.0)


def test_metrics_tell_the_ports_that_are_left() -> None:
    domain = make_domain()
    domain.heard_inside(spdp(A, INSIDE), INSIDE, NOW)
    state = Ros2State([cast(DomainServer, Served(domain))], cast(DomainPlane, Copied()))
    values = {sample.name: sample.value for family in state.collect() for sample in family.samples}
    used, free = (values[f"rosproxy_ros2_leases_{use}"] for use in ("used", "free"))
    assert (used, free) == (len(domain.mappings.by_port), domain.ports.pool.free)
    assert used > 0
    assert values["rosproxy_ros2_participants_without_port"] == 0


def test_metrics_tell_how_many_have_not_proved_to_receive() -> None:
    domain = make_domain()
    domain.heard_inside(spdp(A, INSIDE), INSIDE, NOW)
    domain.heard_inside(spdp(B, OTHER), OTHER, NOW)
    prove(domain, INSIDE)
    state = Ros2State([cast(DomainServer, Served(domain))], cast(DomainPlane, Copied()))
    values = {
        (sample.name, sample.labels.get("side")): sample.value
        for family in state.collect()
        for sample in family.samples
    }
    assert values["rosproxy_ros2_participants", "inside"] == 2
    assert values["rosproxy_ros2_unproven_participants", "inside"] == 1
    assert values["rosproxy_ros2_unproven_participants", "outside"] == 0


def test_outside_comes_in_or_may_still_do_so() -> None:
    """A participant that crashed at once must not count as unable to reach the range."""
    domain = make_domain()
    domain.heard_inside(spdp(A, INSIDE), INSIDE, NOW)
    for seconds, is_proven in ((0.0, True), (COMES_IN_WITHIN_S, False)):
        domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW + seconds)
        (outside,) = told(domain).outside
        assert outside.proven is is_proven
    port = next(iter(domain.mappings.by_port))
    domain.at_range_port(port, spdp(B, ROBOT), ROBOT, NOW + COMES_IN_WITHIN_S)
    (outside,) = told(domain).outside
    assert outside.proven


def test_without_names_no_reader_or_writer_is_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    """The check of the domains, every 5 s, sorted all readers and writers to list none."""
    monkeypatch.setattr("rosproxy.ros2.status._nodes_of", None)
    endpoint = DdsEndpoint(EndpointKind.READER, "rt/chatter", "std_msgs::msg::dds_::String_")
    participant = Participant(A, INSIDE, b"\x01\x0f", 0.0, endpoints={b"only": endpoint})
    assert _first_endpoints(participant, 0) == []
