"""Prometheus metrics: counters that the proxy keeps, and gauges read off its state when scraped."""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from prometheus_client import CollectorRegistry, Counter, Histogram, Info, ProcessCollector
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from rosproxy import __version__
from rosproxy.leases import fast_ports
from rosproxy.ros1.protocol.master_methods import MASTER_METHODS
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.registry.registry import Registry

_SLAVE_METHODS = frozenset(
    {
        "getBusInfo",
        "getBusStats",
        "getMasterUri",
        "getName",
        "getPid",
        "getPublications",
        "getSubscriptions",
        "getUri",
        "paramUpdate",
        "publisherUpdate",
        "requestTopic",
        "shutdown",
    }
)
_OTHER_MASTER_METHODS = frozenset(
    {
        "deleteParam",
        "getParam",
        "getParamNames",
        "getPublishedTopics",
        "getSystemState",
        "getTopicTypes",
        "hasParam",
        "searchParam",
        "setParam",
        "system.multicall",
    }
)
STATES = ("ok", "new", "failing", "refused", "silent", "cleaned", "unverified")
MOST_NAMES = 1000
"""Topics and services with byte counters of their own; the bytes of all others are summed up."""

_KNOWN_METHODS = _SLAVE_METHODS | _OTHER_MASTER_METHODS | frozenset(MASTER_METHODS)


def state_of(endpoint: Endpoint) -> str:
    """One word for an endpoint's state: one of STATES."""
    return endpoint.health.state if endpoint.trusted else "unverified"


class Traffic:
    """Bytes relayed per topic or service, summed over ended connections.

    ``sent`` went outside, ``received`` came from there. Anonymous nodes bring new names for ever,
    so that only the first MOST_NAMES are kept apart.
    """

    def __init__(self) -> None:
        self.sent: dict[tuple[str, str], int] = {}
        self.received: dict[tuple[str, str], int] = {}

    def add(self, kind: str, name: str, sent: int, received: int) -> None:
        """Add the bytes of a connection that ended."""
        key = kind, name
        if key not in self.sent and len(self.sent) >= MOST_NAMES:
            key = kind, "other"
        self.sent[key] = self.sent.get(key, 0) + sent
        self.received[key] = self.received.get(key, 0) + received


@dataclass(frozen=True, slots=True)
class KernelTally:
    """What the kernel forwards: whether it does, how many connections, bytes by node."""

    usable: bool
    connections: int
    traffic: Traffic


class Metrics:
    """All metrics of a proxy, in a registry of their own."""

    def __init__(self) -> None:
        self.started = time.monotonic()
        self.registry = CollectorRegistry()
        ProcessCollector(registry=self.registry)
        build = Info("rosproxy_build", "The proxy's version.", registry=self.registry)
        build.info({"version": __version__})
        self.calls = Counter(
            "rosproxy_xmlrpc_calls",
            "XML-RPC calls by API (master, slave), method and outcome.",
            ["api", "method", "outcome"],
            registry=self.registry,
        )
        self._counters: dict[tuple[str, str, str], Counter] = {}
        self.relay_errors = Counter(
            "rosproxy_relay_errors",
            "TCPROS connections that could not be relayed.",
            ["reason"],
            registry=self.registry,
        )
        self.cleanups = Counter(
            "rosproxy_cleanups",
            "Nodes unregistered at the master because they were gone.",
            registry=self.registry,
        )
        self.exhausted = Counter(
            "rosproxy_range_exhausted",
            "Registrations refused because no port was left.",
            registry=self.registry,
        )
        self.master_round_trip = Histogram(
            "rosproxy_master_round_trip_seconds",
            "Time for a call of the proxy's own to the master.",
            registry=self.registry,
            buckets=(0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 1, 5),
        )

    def count(self, api: str, method: str, outcome: str) -> None:
        """Count a call; method names that nobody defined share one label."""
        known = method if method in _KNOWN_METHODS else "other"
        key = api, known, outcome
        counter = self._counters.get(key) or self._counters.setdefault(key, self.calls.labels(*key))
        counter.inc()


class StateCollector(Collector):
    """Gauges and byte counters, computed from the proxy's state at each scrape."""

    def __init__(
        self,
        registry: Registry,
        totals: Callable[[], Traffic],
        open_connections: Callable[[], int],
        mirrored: Callable[[], int],
        master_up: Callable[[], bool],
        kernel: Callable[[], KernelTally],
    ) -> None:
        self._registry, self._totals = registry, totals
        self._open_connections, self._mirrored = open_connections, mirrored
        self._master_up, self._kernel = master_up, kernel

    def collect(self) -> Iterable[Metric]:
        """All state metrics."""
        pool = self._registry.pool
        left, fast = fast_ports.left(self._registry), fast_ports.held(self._registry)
        yield _gauge("leases_used", "Ports held by inside nodes.", len(self._registry))
        yield _gauge("leases_free", "Ports left for inside nodes.", left)
        yield _gauge("fast_ports", "Of the ports left, those that serve topics meanwhile.", fast)
        yield _gauge("leases_blocked", "Ports of the range held by other programs.", pool.blocked)
        yield _gauge("open_connections", "Relayed TCPROS connections.", self._open_connections())
        yield _gauge(
            "mirrored_ports",
            "Ports that stand in for nodes on the master's host.",
            self._mirrored(),
        )
        yield _gauge("master_up", "Whether the master answers.", int(self._master_up()))
        yield self._endpoints()
        yield self._bytes()
        yield from self._forwarded()

    def _endpoints(self) -> Metric:
        family = GaugeMetricFamily("rosproxy_endpoints", "Inside nodes by state.", labels=["state"])
        states = [state_of(endpoint) for endpoint in self._registry]
        for state in STATES:
            family.add_metric([state], states.count(state))
        return family

    def _bytes(self) -> Metric:
        family = CounterMetricFamily(
            "rosproxy_relayed_bytes",
            "Bytes relayed by topic or service and direction.",
            labels=["kind", "name", "direction"],
        )
        totals = self._totals()
        for direction, sums in (("outward", totals.sent), ("inward", totals.received)):
            for (kind, name), size in sums.items():
                family.add_metric([kind, name, direction], size)
        return family

    def _forwarded(self) -> Iterable[Metric]:
        tally = self._kernel()
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
