"""The proxy's state as Prometheus metrics, read when they are scraped."""

from collections.abc import Iterable

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from rosproxy.forwarding.kernel.plane import KernelPlane
from rosproxy.leases import fast_ports
from rosproxy.ros1.alias.alias import Alias
from rosproxy.ros1.registry.endpoint import STATES
from rosproxy.ros1.registry.registry import Registry
from rosproxy.ros1.servers.tcpros import TcprosServer
from rosproxy.ros1.upkeep.master_monitor import MasterMonitor


class StateCollector(Collector):
    """Gauges and byte counters, computed from the proxy's state at each scrape."""

    def __init__(
        self,
        registry: Registry,
        tcpros: TcprosServer,
        alias: Alias,
        monitor: MasterMonitor,
        plane: KernelPlane,
    ) -> None:
        self._registry, self._tcpros, self._alias = registry, tcpros, alias
        self._monitor, self._plane = monitor, plane

    def collect(self) -> Iterable[Metric]:
        """All state metrics."""
        endpoints, pool = self._registry, self._registry.pool
        forwarded = sum(endpoint.fast_connections for endpoint in endpoints)
        for name, text, value in (
            ("leases_used", "Ports held by inside nodes.", len(endpoints)),
            ("leases_free", "Ports left for inside nodes.", fast_ports.left(pool, endpoints)),
            (
                "fast_ports",
                "Of the ports left, those that serve topics meanwhile.",
                fast_ports.held(endpoints),
            ),
            ("leases_blocked", "Ports of the range held by other programs.", len(pool.blocked)),
            ("open_connections", "Relayed TCPROS connections.", len(self._tcpros.relays)),
            (
                "alias_ports",
                "Ports that stand in for nodes on the master's host.",
                len(self._alias.status()),
            ),
            ("master_up", "Whether the master answers.", bool(self._monitor.up)),
            ("kernel_plane", "Whether the kernel forwards topics.", self._plane.syncer.usable),
            ("kernel_connections", "TCPROS connections that the kernel forwards.", forwarded),
        ):
            yield GaugeMetricFamily(f"rosproxy_{name}", text, value=value)
        states = [endpoint.state for endpoint in endpoints]
        by_state = GaugeMetricFamily(
            "rosproxy_endpoints", "Inside nodes by state.", labels=["state"]
        )
        for state in STATES:
            by_state.add_metric([state], states.count(state))
        yield by_state
        yield from self._bytes()

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
            forwarded.add_metric(labels[1:], size)
        return relayed, forwarded
