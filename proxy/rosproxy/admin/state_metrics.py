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
        pool = self._registry.pool
        left, fast = fast_ports.left(pool, self._registry), fast_ports.held(self._registry)
        yield _gauge("leases_used", "Ports held by inside nodes.", len(self._registry))
        yield _gauge("leases_free", "Ports left for inside nodes.", left)
        yield _gauge("fast_ports", "Of the ports left, those that serve topics meanwhile.", fast)
        yield _gauge("leases_blocked", "Ports of the range held by other programs.", pool.blocked)
        yield _gauge("open_connections", "Relayed TCPROS connections.", len(self._tcpros.relays))
        yield _gauge(
            "alias_ports",
            "Ports that stand in for nodes on the master's host.",
            len(self._alias.status()),
        )
        yield _gauge("master_up", "Whether the master answers.", int(bool(self._monitor.up)))
        yield self._endpoints()
        yield self._bytes()
        yield from self._forwarded()

    def _endpoints(self) -> Metric:
        family = GaugeMetricFamily("rosproxy_endpoints", "Inside nodes by state.", labels=["state"])
        states = [endpoint.state for endpoint in self._registry]
        for state in STATES:
            family.add_metric([state], states.count(state))
        return family

    def _bytes(self) -> Metric:
        family = CounterMetricFamily(
            "rosproxy_relayed_bytes",
            "Bytes relayed by topic or service and direction.",
            labels=["kind", "name", "direction"],
        )
        totals = self._tcpros.traffic()
        for direction, sums in (("outward", totals.sent), ("inward", totals.received)):
            for (kind, name), size in sums.items():
                family.add_metric([kind, name, direction], size)
        return family

    def _forwarded(self) -> Iterable[Metric]:
        tally = self._plane.tally()
        yield _gauge("kernel_plane", "Whether the kernel forwards topics.", int(tally.usable))
        yield _gauge(
            "kernel_connections", "TCPROS connections that the kernel forwards.", tally.connections
        )
        family = CounterMetricFamily(
            "rosproxy_kernel_bytes",
            "Bytes of IP packets, headers included, that the kernel forwarded, by node.",
            labels=["node", "direction"],
        )
        for direction, sums in (
            ("outward", tally.traffic.sent),
            ("inward", tally.traffic.received),
        ):
            for (_, name), size in sums.items():
                family.add_metric([name, direction], size)
        yield family


def _gauge(name: str, text: str, value: float) -> Metric:
    return GaugeMetricFamily(f"rosproxy_{name}", text, value=value)
