"""The state of ROS 1 in a running proxy: as a part of ``/status``, and as metrics."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from operator import attrgetter

import msgspec
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from rosproxy.admin.common_status import MOST_HIDDEN, with_hidden
from rosproxy.forwarding import fast_ports
from rosproxy.forwarding.kernel.plane import KernelPlane
from rosproxy.forwarding.relay import Relay
from rosproxy.net import proxy_signs
from rosproxy.ros1.context import Context
from rosproxy.ros1.policy.checks import RULE_KINDS
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import STATES, Endpoint
from rosproxy.ros1.servers.tcpros_server import TcprosServer
from rosproxy.ros1.stand_ins.stand_in_ports import StandInPorts
from rosproxy.ros1.upkeep.master_monitor import MasterMonitor
from rosproxy.ros1.upkeep.message_counter import MessageCounter
from rosproxy.shared.documents import status_document as document
from rosproxy.shared.documents.status_bounds import fair_choice
from rosproxy.telemetry.metrics import NamedNodes

MOST_CONNECTIONS = 1000
"""Connections of a node that the status lists; each address that connects has a fair share."""


@dataclass(eq=False)
class Ros1State(Collector):
    """The state of ROS 1, read at each request."""

    _context: Context
    _monitor: MasterMonitor
    _tcpros: TcprosServer
    _stand_ins: StandInPorts
    _plane: KernelPlane
    _messages: MessageCounter
    _down: NamedNodes = field(default_factory=NamedNodes)

    def extended_status(self, status: document.ProxyStatus) -> document.ProxyStatus:
        """The state, with what ``rosproxy status`` and ``doctor`` show of ROS 1."""
        context = self._context
        relays: dict[int, list[Relay]] = {}
        for relay in self._tcpros.relays:
            relays.setdefault(relay.port, []).append(relay)
        endpoints = sorted(context.registry, key=lambda endpoint: endpoint.port)
        return msgspec.structs.replace(
            status,
            retired=context.retired,
            settings=self._settings(status.settings),
            master=self._master(),
            ports=self._ports(),
            data_plane=msgspec.convert(self._plane.status(), document.DataPlaneStatus),
            udpros=tuple(
                document.UdprosStatus(
                    subscription.topic,
                    subscription.caller_id,
                    subscription.peer,
                    relay.port,
                    subscription.inside_asks,
                    relay.sent,
                    relay.dropped,
                )
                for subscription, relay in self._stand_ins.udpros
            ),
            stand_ins=msgspec.convert(self._stand_ins.status(), tuple[document.StandInStatus, ...]),
            policy=with_hidden(status.policy, *self._hidden()),
            nodes=tuple(self._node(e, relays.get(e.port, [])) for e in endpoints),
        )

    def collect(self) -> Iterable[Metric]:
        """The state as metrics: gauges, and counters of bytes."""
        for name, text, value in self._numbers():
            yield GaugeMetricFamily(f"rosproxy_{name}", text, value=value)
        if self._context.selected is not None:
            text = "Addresses that may use the proxy as their master."
            count = len(self._context.selected)
            yield GaugeMetricFamily("rosproxy_selected_addresses", text, value=count)
        states = [endpoint.state for endpoint in self._context.registry]
        by_state = GaugeMetricFamily(
            "rosproxy_endpoints", "Inside nodes by state.", labels=["state"]
        )
        for state in STATES:
            by_state.add_metric([state], states.count(state))
        yield by_state
        yield self._nodes_down()
        yield from self._bytes()
        yield from self._counted_by_nodes()

    def _numbers(self) -> Iterator[tuple[str, str, float]]:
        """Name, meaning and value of each gauge without labels."""
        context = self._context
        endpoints = self._context.registry
        pool = endpoints.pool
        buffered = context.buffered
        yield "leases_used", "Ports held by inside nodes.", len(endpoints)
        yield "leases_free", "Ports left for inside nodes.", fast_ports.ports_left(pool, endpoints)
        text = "Free ports that serve as fast ports now."
        yield "fast_ports", text, fast_ports.fast_port_count(endpoints)
        yield "leases_blocked", "Ports of the range held by other programs.", len(pool.blocked)
        yield "open_connections", "Relayed TCPROS connections.", len(self._tcpros.relays)
        text = "Ports that stand in for nodes outside."
        yield "stand_ins", text, len(context.stand_ins.by_local)
        text = "Subscriptions by UDPROS that the proxy passes on."
        yield "udpros_relays", text, len(self._stand_ins.udpros)
        text = "Memory that calls and replies hold while they are read."
        yield "buffered_bytes", text, buffered.used
        yield (
            "buffered_bytes_limit",
            "Limit of the memory that calls and replies hold.",
            buffered.most,
        )
        yield "master_up", "Whether the master answers.", bool(self._monitor.up)
        text = "Whether the kernel forwards topics."
        yield "kernel_plane", text, self._plane.syncer.usable
        forwarded = sum(holder.fast_connections for holder in self._plane.holders)
        yield "kernel_connections", "TCPROS connections that the kernel forwards.", forwarded

    def _nodes_down(self) -> Metric:
        """The nodes that do not answer, by name, for alerts."""
        text = "Inside nodes that do not answer, by name."
        gauge = GaugeMetricFamily("rosproxy_nodes_down", text, labels=["node"])
        down = [e for e in self._context.registry if e.is_down and not e.health.has_ended]
        names = [name for endpoint in down for name in endpoint.caller_ids]
        for name, count in self._down.tally(names).items():
            gauge.add_metric([name], count)
        return gauge

    def _bytes(self) -> Iterable[Metric]:
        relayed = CounterMetricFamily(
            "rosproxy_relayed_bytes",
            "Bytes relayed by topic or service and direction.",
            labels=["kind", "name", "direction"],
        )
        for labels, size in self._tcpros.traffic().totals():
            relayed.add_metric(labels, size)
        forwarded = CounterMetricFamily(
            "rosproxy_kernel_bytes",
            "Bytes of IP packets, headers included, that the kernel forwarded, by node.",
            labels=["node", "direction"],
        )
        for labels, size in self._plane.traffic.totals():
            forwarded.add_metric(labels[1:], size)  # the first label is always "node"
        return relayed, forwarded

    def _counted_by_nodes(self) -> Iterable[Metric]:
        labels = ["name", "side"]
        text = "Messages of topics that inside nodes published or received, as the nodes count."
        messages = CounterMetricFamily("rosproxy_topic_messages", text, labels=labels)
        text = "Bytes of topics that inside nodes published or received, as the nodes count."
        sizes = CounterMetricFamily("rosproxy_topic_bytes", text, labels=labels)
        for key, (size, count) in self._messages.read().by_topic.items():
            messages.add_metric(key, count)
            sizes.add_metric(key, size)
        return messages, sizes

    def _settings(self, common: document.StatusSettings) -> document.StatusSettings:
        settings = self._context.settings
        selected = self._context.selected
        return msgspec.structs.replace(
            common,
            master_port=settings.master_port,
            publish_master=settings.publish_master,
            inside_networks=tuple(map(str, self._context.addressing.networks)),
            udp=settings.udp,
            cleanup_after=settings.cleanup_after,
            linger=settings.linger,
            selected=None if selected is None else len(selected),
        )

    def _master(self) -> document.MasterStatus:
        context = self._context
        monitor = self._monitor
        return document.MasterStatus(
            uri=context.settings.master_uri,
            address=context.upstream.reached_at,
            pinned=context.upstream.master_address is not None,
            up=bool(monitor.up),
            error=monitor.error,
            pid=monitor.pid,
            since=round(context.now() - monitor.since, 1),
            round_trip=monitor.round_trip,
        )

    def _ports(self) -> document.PortsStatus:
        ports = self._context.settings.ports
        registry = self._context.registry
        return document.PortsStatus(
            listen=str(ports.listen),
            advertise=str(ports.advertise),
            used=len(registry),
            free=fast_ports.ports_left(registry.pool, registry),
            blocked=len(registry.pool.blocked),
            held_by=self._held_by() if registry.pool.blocked else (),
        )

    def _held_by(self) -> tuple[str, ...]:
        """The other proxies on this machine that have ports of the range."""
        settings = self._context.settings
        ports = settings.ports.listen
        return tuple(
            map(str, proxy_signs.overlapping_proxies("1", ports.first, ports.last, settings.admin))
        )

    def _hidden(self) -> tuple[list[document.HiddenStatus], int]:
        """The registrations that the policy hides, and how many of them the list leaves out."""
        policy = self._context.policy
        hidden = self._context.registry.hidden_registrations()
        rows = [
            document.HiddenStatus(
                RULE_KINDS[registration.kind].value,
                registration.name,
                registration.caller_id,
                policy.verdict(endpoint, registration).reason,
                endpoint.address,
            )
            for endpoint, registration in fair_choice(
                hidden, lambda pair: pair[0].address, MOST_HIDDEN
            )
        ]
        return sorted(rows, key=str), len(hidden) - len(rows)

    def _node(self, endpoint: Endpoint, relays: list[Relay]) -> document.EndpointStatus:
        problems = self._context.problems.at(endpoint.port)
        shown_relays = fair_choice(relays, attrgetter("peer"), MOST_CONNECTIONS)
        return document.EndpointStatus(
            nodes=tuple(endpoint.caller_ids),
            uri=endpoint.uri,
            address=str(endpoint.slave),
            advertised_uri=self._context.addressing.advertised_uri(endpoint),
            port=endpoint.port,
            state=endpoint.state,
            publishes=tuple(endpoint.names(Kind.PUBLISHER)),
            subscribes=tuple(endpoint.names(Kind.SUBSCRIBER)),
            services=tuple(endpoint.names(Kind.SERVICE)),
            parameters=tuple(endpoint.names(Kind.PARAM)),
            connections=msgspec.convert(
                shown_relays, tuple[document.ConnectionStatus, ...], from_attributes=True
            ),
            left_out=len(relays) - len(shown_relays),
            problems=tuple(problem.text for problem in problems),
            data_plane=msgspec.convert(self._plane.status_of(endpoint), document.NodePlaneStatus),
            unanswered=round(endpoint.health.unanswered(self._context.now()), 1),
        )
