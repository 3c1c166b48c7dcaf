"""The state of ROS 2 in a running proxy: as a part of ``/status``, and as metrics."""

import asyncio
from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import TypeVar

import msgspec
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from rosproxy.access.access_policy import AccessPolicy
from rosproxy.admin.common_status import MOST_HIDDEN
from rosproxy.ros2.discovery.domain import Domain
from rosproxy.ros2.domain_plane import DomainPlane
from rosproxy.ros2.protocol.ros_names import (
    is_of_requests,
    is_of_service,
    ros_name,
    ros_node,
    ros_type,
)
from rosproxy.ros2.registry.matching import Comparison, MismatchedPair, comparison_steps
from rosproxy.ros2.registry.participants import (
    DdsEndpoint,
    EndpointKind,
    InsideParticipant,
    OutsideParticipant,
    Participant,
    PortShortage,
)
from rosproxy.ros2.servers.domain_server import DomainServer
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.documents import status_document as document
from rosproxy.shared.documents.status_bounds import fair_choice, fair_shares_by_owner

MOST_LISTED_ENDPOINTS = 8192
"""The most readers and writers that the status lists by name, for each side of a domain.

Each address gets a fair share.

A host with fifty nodes has some 1,000. Listing 8,192 takes 30 ms, and the event loop waits
meanwhile."""
MOST_LISTED_MISMATCHES = 100
"""Mismatches of a domain that are listed, with fair shares by the address inside."""
MOST_STEPS_AT_ONCE = 4
"""Steps of a comparison that a status may take, some 10 ms. A host with fifty nodes and a robot
with as many take more. Then the status has the comparison of the last check."""
_NO_SHORTAGE = PortShortage()
_Participant = TypeVar("_Participant", bound=Participant)


class Comparisons:
    """The comparisons of the readers and writers of each domain."""

    def __init__(self) -> None:
        self._last: dict[int, Comparison] = {}

    def of(self, domain: Domain) -> Comparison:
        """A comparison that is made now, or that of the last `renew` if it takes too long."""
        steps = _steps(domain)
        try:
            for _ in range(MOST_STEPS_AT_ONCE):
                next(steps)
        except StopIteration as end:
            comparison: Comparison = end.value
            return comparison
        return self._last.get(domain.settings.number, Comparison())

    async def renew(self, domains: Iterable[Domain]) -> None:
        """Compare the readers and writers of domains. The proxy forwards between the steps."""
        for domain in domains:
            steps = _steps(domain)
            try:
                while True:
                    next(steps)
                    await asyncio.sleep(0)
            except StopIteration as end:
                self._last[domain.settings.number] = end.value


def _steps(domain: Domain) -> Generator[None, None, Comparison]:
    return comparison_steps(domain.inside.by_prefix.values(), domain.outside.by_prefix.values())


@dataclass(eq=False)
class Ros2State(Collector):
    """The state of ROS 2, read at each request.

    Without ``with_names`` no topics and services are listed, which takes a tenth of the time.
    """

    _servers: Sequence[DomainServer]
    _plane: DomainPlane
    with_names: bool = True
    comparisons: Comparisons = field(default_factory=Comparisons)

    def status(self) -> tuple[document.DomainStatus, ...]:
        """The status of each domain."""
        return tuple(self._domain(server) for server in self._servers)

    def hidden(self, policy: AccessPolicy) -> tuple[list[document.HiddenStatus], int]:
        """The names that the policy hides from outside, and how many are left out."""
        hidden = [
            (participant, kind, name)
            for server in self._servers
            for participant in server.domain.inside.by_prefix.values()
            for (kind, name), allowed in participant.verdicts.items()
            if not allowed
        ]
        rows = [
            document.HiddenStatus(
                kind.value,
                name,
                participant.guid_prefix,
                policy.judge(kind, name, (), participant.address).reason,
                participant.address,
            )
            for participant, kind, name in fair_choice(
                hidden, lambda entry: entry[0].address, MOST_HIDDEN
            )
        ]
        return rows, len(hidden) - len(rows)

    def collect(self) -> Iterable[Metric]:
        """The metrics of all domains: gauges, and counters of datagrams."""
        yield from self._participants()
        used = GaugeMetricFamily(
            "rosproxy_ros2_leases_used", "Ports of the range held by locators.", labels=["domain"]
        )
        free = GaugeMetricFamily(
            "rosproxy_ros2_leases_free", "Ports of the range left for locators.", labels=["domain"]
        )
        lacking = GaugeMetricFamily(
            "rosproxy_ros2_participants_without_port",
            "Participants inside with a locator that got no port.",
            labels=["domain"],
        )
        dropped = CounterMetricFamily(
            "rosproxy_ros2_dropped_datagrams", "Datagrams that were refused.", labels=["domain"]
        )
        overflowed = CounterMetricFamily(
            "rosproxy_ros2_overflowed_datagrams",
            "Datagrams that the kernel dropped because a receive buffer of the proxy was full.",
            labels=["domain"],
        )
        passed = CounterMetricFamily(
            "rosproxy_ros2_relayed_bytes",
            "Bytes of datagrams passed on.",
            labels=["domain", "kind", "direction"],
        )
        for server in self._servers:
            domain = server.domain
            number = str(server.domain.settings.number)
            used.add_metric([number], len(domain.mappings.by_port))
            free.add_metric([number], domain.ports.pool.free)
            lacking.add_metric([number], len(domain.mappings.shortages))
            dropped.add_metric([number], domain.refused.count)
            overflowed.add_metric([number], server.buffers.overflowed)
            for (kind, inwards), size in domain.passed.items():
                passed.add_metric([number, kind.value, "inward" if inwards else "outward"], size)
        yield from (used, free, lacking, dropped, overflowed, passed)

    def _participants(self) -> Iterator[Metric]:
        gauge = GaugeMetricFamily(
            "rosproxy_ros2_participants", "Participants by side.", labels=["domain", "side"]
        )
        unproven = GaugeMetricFamily(
            "rosproxy_ros2_unproven_participants",
            "Participants at addresses that have not answered the proxy's question. A large number "
            "is a sign of forged sources.",
            labels=["domain", "side"],
        )
        for server in self._servers:
            domain = server.domain
            number = str(domain.settings.number)
            sides = {
                "inside": domain.inside.count_by_address,
                "outside": domain.outside.count_by_address,
            }
            for side, counts in sides.items():
                gauge.add_metric([number, side], counts.total())
                unproven_counts = (n for a, n in counts.items() if not domain.proofs.has(a))
                unproven.add_metric([number, side], sum(unproven_counts))
        yield gauge
        yield unproven

    def _domain(self, server: DomainServer) -> document.DomainStatus:
        domain = server.domain
        settings = server.domain.settings
        discovery = settings.ports.advertised(settings.discovery_port)
        comparison = self.comparisons.of(domain)
        pairs = comparison.mismatched
        shortages = domain.mappings.shortages
        shown_pairs = fair_choice(pairs, _address_inside, MOST_LISTED_MISMATCHES)
        return document.DomainStatus(
            domain=settings.number,
            discovery=str(HostPort(settings.host, discovery)),
            peers=tuple(peer.host if not peer.port else str(peer) for peer in settings.peers),
            lan_relay=str(settings.relay.address) if settings.relay else "",
            direction="both" if settings.both_ways else "out",
            ports_used=len(domain.mappings.by_port),
            ports_free=domain.ports.pool.free,
            dropped=domain.refused.count,
            lost=server.lost,
            overflowed=server.buffers.overflowed,
            overflowed_recently=server.buffers.overflowed_recently,
            receive_buffer=server.buffers.size_bytes,
            data_plane=self._plane.status(),
            mismatches=tuple(map(_mismatch, shown_pairs)),
            mismatches_left_out=len(pairs) - len(shown_pairs),
            not_compared=comparison.left_out,
            inside=tuple(
                self._inside(
                    p, most, shortages.get(p.prefix, _NO_SHORTAGE), domain.has_confirmed_ports(p)
                )
                for p, most in self._shares(domain.inside.by_prefix.values())
            ),
            outside=tuple(
                self._outside(p, most)
                for p, most in self._shares(domain.outside.by_prefix.values())
            ),
            unselected=tuple(sorted(server.unselected)),
        )

    def _shares(self, participants: Iterable[_Participant]) -> Iterator[tuple[_Participant, int]]:
        """Each participant of a side, and the number of its readers and writers to list."""
        every = list(participants)
        most = MOST_LISTED_ENDPOINTS if self.with_names else 0
        counts = [len(participant.endpoints) for participant in every]
        owners = [participant.address for participant in every]
        return zip(every, fair_shares_by_owner(owners, counts, most), strict=True)

    def _inside(
        self,
        participant: InsideParticipant,
        most: int,
        shortage: PortShortage,
        ports_confirmed: bool,
    ) -> document.ParticipantStatus:
        return msgspec.structs.replace(
            self._status_of(participant, most),
            kept=ports_confirmed,
            problem=shortage.text,
            shortage=shortage.kind.value,
        )

    def _outside(self, participant: OutsideParticipant, most: int) -> document.ParticipantStatus:
        status = self._status_of(participant, most)
        # ``proven`` is about the ports of the range. `AddressProofs` is about the address.
        return msgspec.structs.replace(status, proven=participant.comes_in)

    def _status_of(self, participant: Participant, most: int) -> document.ParticipantStatus:
        endpoints = _first_endpoints(participant, most)
        publishes = set[str]()
        subscribes = set[str]()
        services = set[str]()
        types: dict[str, str] = {}
        for endpoint in endpoints:
            name = ros_name(endpoint.topic)
            types[name] = ros_type(endpoint.type_name)
            if not is_of_service(endpoint.topic):
                (publishes if endpoint.kind is EndpointKind.WRITER else subscribes).add(name)
            elif endpoint.kind is EndpointKind.READER and is_of_requests(endpoint.topic):
                services.add(name)
        named = types.keys() & (publishes | subscribes | services) - {""}
        return document.ParticipantStatus(
            guid_prefix=participant.guid_prefix,
            address=participant.address,
            vendor=participant.vendor_name,
            leases=tuple(
                self._plane.locator(participant, mapping)
                for mapping in participant.mappings.values()
            ),
            publishes=tuple(sorted(publishes - {""})),
            subscribes=tuple(sorted(subscribes - {""})),
            services=tuple(sorted(services - {""})),
            nodes=tuple(sorted({node for endpoint in endpoints for node in _nodes_of(endpoint)})),
            left_out=len(participant.endpoints) - len(endpoints) if self.with_names else 0,
            domain=participant.traits.domain,
            security=participant.traits.security.value,
            locator_fault=participant.traits.locator_fault.value,
            types=tuple(document.NamedTypeStatus(name, types[name]) for name in sorted(named)),
        )


def _first_endpoints(participant: Participant, most: int) -> list[DdsEndpoint]:
    """At most ``most`` readers and writers; those that name nodes come first."""
    endpoints = participant.endpoints.values()
    if not most:
        return []
    if most < len(endpoints):
        return list(islice(sorted(endpoints, key=lambda e: not _nodes_of(e)), most))
    return list(endpoints)


def _nodes_of(endpoint: DdsEndpoint) -> tuple[str, ...]:
    """The ROS nodes that a reader names by its topic (`ros_node`), or a writer by its samples."""
    if endpoint.kind is not EndpointKind.READER:
        return endpoint.nodes
    node = ros_node(endpoint.topic, endpoint.type_name)
    return (node,) if node else ()


def _address_inside(pair: MismatchedPair) -> str:
    """The address of the participant inside in a pair."""
    insider = pair.writer if isinstance(pair.writer, InsideParticipant) else pair.reader
    return insider.address


def _mismatch(pair: MismatchedPair) -> document.MismatchStatus:
    return document.MismatchStatus(
        kind="service" if is_of_service(pair.topic) else "topic",
        name=ros_name(pair.topic),
        policy=pair.mismatch.policy,
        offered=pair.mismatch.offered,
        requested=pair.mismatch.requested,
        writer=pair.writer.guid_prefix,
        reader=pair.reader.guid_prefix,
    )
