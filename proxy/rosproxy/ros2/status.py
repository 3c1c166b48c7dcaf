"""The state of ROS 2 in a running proxy: as a part of ``/status``, and as metrics."""

from collections.abc import Container, Iterable, Iterator, Sequence
from dataclasses import dataclass

import msgspec
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from rosproxy.access.access_policy import AccessPolicy
from rosproxy.admin import status_document as document
from rosproxy.admin.status_bounds import bounded_names
from rosproxy.net.addresses import HostPort
from rosproxy.ros2.domain_plane import DomainPlane
from rosproxy.ros2.protocol.ros_names import (
    is_of_service,
    ros_name,
    ros_service,
    ros_topic,
    ros_type,
)
from rosproxy.ros2.registry.matching import MismatchedPair, mismatched_pairs
from rosproxy.ros2.registry.participants import (
    DdsEndpoint,
    EndpointKind,
    InsideParticipant,
    OutsideParticipant,
    Participant,
    PortShortage,
)
from rosproxy.ros2.servers.domain_server import DomainServer

MOST_NAMES = 200
"""Topics and services of a participant that are listed; the rest is counted."""
MOST_MISMATCHES = 100
"""Mismatches of a domain that are listed; the rest is counted."""
_NO_SHORTAGE = PortShortage()


@dataclass(eq=False)
class Ros2State(Collector):
    """What there is to tell of ROS 2, read when somebody asks.

    Without ``with_names`` no topics and services are listed: that takes a tenth of the time.
    """

    _servers: Sequence[DomainServer]
    _plane: DomainPlane
    with_names: bool = True

    def status(self) -> tuple[document.DomainStatus, ...]:
        """The domains."""
        return tuple(self._domain(server) for server in self._servers)

    def hidden(self, policy: AccessPolicy) -> Iterator[document.HiddenStatus]:
        """What the policy keeps from participants outside."""
        for server in self._servers:
            for participant in server.domain.inside.by_prefix.values():
                for (kind, name), allowed in participant.verdicts.items():
                    if not allowed:
                        reason = policy.judge(kind, name, (), participant.address).reason
                        yield document.HiddenStatus(
                            kind.value, name, participant.guid_prefix, reason
                        )

    def collect(self) -> Iterable[Metric]:
        """The state as metrics: gauges, and counters of datagrams."""
        yield from self._participants()
        used = GaugeMetricFamily(
            "rosproxy_ros2_leases_used", "Ports of the range held by locators.", labels=["domain"]
        )
        free = GaugeMetricFamily(
            "rosproxy_ros2_leases_free", "Ports of the range left for locators.", labels=["domain"]
        )
        lacking = GaugeMetricFamily(
            "rosproxy_ros2_participants_without_port",
            "Participants inside with locators that got no port.",
            labels=["domain"],
        )
        dropped = CounterMetricFamily(
            "rosproxy_ros2_dropped_datagrams", "Datagrams that were refused.", labels=["domain"]
        )
        passed = CounterMetricFamily(
            "rosproxy_ros2_relayed_bytes",
            "Bytes of datagrams passed on.",
            labels=["domain", "kind", "direction"],
        )
        for server in self._servers:
            domain, number = server.domain, str(server.domain.settings.number)
            used.add_metric([number], len(domain.inside.leases))
            free.add_metric([number], domain.ports.pool.free)
            lacking.add_metric([number], len(domain.inside.port_shortages))
            dropped.add_metric([number], domain.refused.count)
            for (kind, inwards), size in domain.passed.items():
                passed.add_metric([number, kind.value, "inward" if inwards else "outward"], size)
        yield from (used, free, lacking, dropped, passed)

    def _participants(self) -> Iterator[Metric]:
        gauge = GaugeMetricFamily(
            "rosproxy_ros2_participants", "Participants by side.", labels=["domain", "side"]
        )
        unproven = GaugeMetricFamily(
            "rosproxy_ros2_unproven_participants",
            "Participants at addresses that have not proved to receive; many mean forged sources.",
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
                are_unproven = (n for a, n in counts.items() if not domain.proofs.has(a))
                unproven.add_metric([number, side], sum(are_unproven))
        yield gauge
        yield unproven

    def _domain(self, server: DomainServer) -> document.DomainStatus:
        domain, settings = server.domain, server.domain.settings
        discovery = settings.ports.advertised(settings.discovery_port)
        pairs = mismatched_pairs(
            domain.inside.by_prefix.values(), domain.outside.by_prefix.values()
        )
        return document.DomainStatus(
            domain=settings.number,
            discovery=str(HostPort(settings.host, discovery)),
            peers=tuple(peer.host if not peer.port else str(peer) for peer in settings.peers),
            ear=str(settings.relay.address) if settings.relay else "",
            direction="both" if settings.both_ways else "out",
            ports_used=len(domain.inside.leases),
            ports_free=domain.ports.pool.free,
            dropped=domain.refused.count,
            lost=server.lost,
            data_plane=self._plane.status(),
            mismatches=tuple(map(_mismatch, pairs[:MOST_MISMATCHES])),
            mismatches_left_out=max(len(pairs) - MOST_MISMATCHES, 0),
            inside=bounded_names(
                self._inside(
                    p, domain.inside.port_shortages.get(p.prefix, _NO_SHORTAGE), domain.is_kept(p)
                )
                for p in domain.inside.by_prefix.values()
            ),
            outside=bounded_names(self._outside(p) for p in domain.outside.by_prefix.values()),
        )

    def _inside(
        self, participant: InsideParticipant, shortage: PortShortage, kept: bool
    ) -> document.ParticipantStatus:
        return msgspec.structs.replace(
            self._status_of(participant),
            kept=kept,
            problem=shortage.text,
            shortage=shortage.kind.value,
        )

    def _outside(self, participant: OutsideParticipant) -> document.ParticipantStatus:
        return msgspec.structs.replace(self._status_of(participant), proven=participant.has_come_in)

    def _status_of(self, participant: Participant) -> document.ParticipantStatus:
        endpoints = list(participant.endpoints.values()) if self.with_names else []
        writers = {endpoint.topic for endpoint in endpoints if endpoint.kind is EndpointKind.WRITER}
        readers = {endpoint.topic for endpoint in endpoints if endpoint.kind is EndpointKind.READER}
        lists = [
            sorted(filter(None, map(ros_topic, writers))),
            sorted(filter(None, map(ros_topic, readers))),
            sorted(filter(None, map(ros_service, readers))),
        ]
        shown = [names[:MOST_NAMES] for names in lists]
        left_out = sum(map(len, lists)) - sum(map(len, shown))
        return document.ParticipantStatus(
            guid_prefix=participant.guid_prefix,
            address=participant.address,
            vendor=participant.vendor_name,
            leases=tuple(self._plane.locator(lease) for lease in participant.leases.values()),
            publishes=tuple(shown[0]),
            subscribes=tuple(shown[1]),
            services=tuple(shown[2]),
            left_out=left_out,
            domain=participant.traits.domain,
            security=participant.traits.security.value,
            locator_fault=participant.traits.locator_fault.value,
            types=_types(endpoints, {name for names in shown for name in names}),
        )


def _types(
    endpoints: Iterable[DdsEndpoint], names: Container[str]
) -> tuple[document.NamedTypeStatus, ...]:
    """The types of topics and services, one for each."""
    types = {ros_name(endpoint.topic): ros_type(endpoint.type_name) for endpoint in endpoints}
    return tuple(
        document.NamedTypeStatus(name, kind)
        for name, kind in sorted(types.items())
        if name in names
    )


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
