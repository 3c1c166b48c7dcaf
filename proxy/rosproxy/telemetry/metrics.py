"""Prometheus metrics: the counters of the proxy.

`ros1.status` and `ros2.status` have the metrics of the proxy's state, with the bytes of
connections. Counters with few label values begin with 0. In a series that begins with 1, Prometheus
sees no increase, and an alert would miss the first event.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping
from functools import cache

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    Info,
    ProcessCollector,
    disable_created_metrics,
)

from rosproxy import __version__

# prometheus_client adds a second series for each counter, with its start time: no alert and no
# dashboard uses these series.
disable_created_metrics()  # type: ignore[no-untyped-call]

MOST_NAMES = 1000
"""Topics and services with separate byte counters; one counter has the bytes of all others.

Nodes that are down have the same bound of names (`NamedNodes`).
"""
BOUND_REASONS = (
    *("long_body", "slow_body", "compressed", "over_budget", "long_name", "too_many_names"),
    *("connections_per_source", "connections_per_lease", "silent_connections"),
    *("malformed", "participants", "rate", "stand_ins"),
)
"""Reasons of refusals (docs/reference/limits.md) that do not occur in a system without faults or
attacks."""
RELAY_ERRORS = ("bad header", "denied", "node unreachable", "not offered")
STRANGERS = ("outside", "unselected")


class Traffic:
    """Bytes relayed per topic or service, summed over ended connections.

    ``sent`` went outside, ``received`` came from outside. Anonymous nodes bring ever new names, so
    only the first MOST_NAMES names have separate sums.
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

    def totals(self) -> Iterator[tuple[list[str], int]]:
        """Pairs of the labels (kind, name, direction) and the bytes."""
        for direction, sums in (("outward", self.sent), ("inward", self.received)):
            for key, size in sums.items():
                yield [*key, direction], size


class NamedNodes:
    """Numbers of nodes by name; only the first MOST_NAMES names have separate numbers."""

    def __init__(self) -> None:
        self._names: set[str] = set()

    def tally(self, names: Iterable[str]) -> Mapping[str, int]:
        """How often each name occurs; ``other`` stands for all names above the bound."""
        counts: dict[str, int] = {}
        for name in names:
            if len(self._names) < MOST_NAMES:
                self._names.add(name)
            key = name if name in self._names else "other"
            counts[key] = counts.get(key, 0) + 1
        return counts


class Metrics:
    """All metrics of a proxy, in a separate registry.

    Calls of ``known_methods`` are counted by method, and all other calls together.
    """

    known_methods: Collection[str] = ()

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        ProcessCollector(registry=self.registry)
        build = Info("rosproxy_build", "The proxy's version.", registry=self.registry)
        build.info({"version": __version__})

        def counter(name: str, text: str, *labels: str) -> Counter:
            return Counter(f"rosproxy_{name}", text, labels, registry=self.registry)

        calls = "XML-RPC calls by API (master, slave), method and outcome."
        self.calls = counter("xmlrpc_calls", calls, "api", "method", "outcome")
        self._of_calls = cache(self.calls.labels)
        errors = "TCPROS connections that could not be relayed."
        self.relay_errors = counter("relay_errors", errors, "reason")
        gone = "Dead nodes that the proxy unregistered at the master."
        self.cleanups = counter("cleanups", gone)
        refused = "Registrations refused because no port was free."
        self.exhausted = counter("range_exhausted", refused)
        bounds = "Requests and connections above a bound, refused, by reason."
        self.refused = counter("refused", bounds, "reason")
        denied = "Denials by the policy, or in audit mode would-be denials, by kind of rule."
        self.policy_denied = counter("policy_denied", denied, "kind", "mode")
        strangers = "Calls refused because of their source address, by standing of the address."
        self.strangers = counter("strangers", strangers, "standing")
        for family, values in (
            (self.relay_errors, RELAY_ERRORS),
            (self.refused, BOUND_REASONS),
            (self.strangers, STRANGERS),
        ):
            for value in values:
                family.labels(value)
        faults = "Faults that the proxy finds in its own address and range."
        self.setup_faults = Gauge("rosproxy_setup_faults", faults, registry=self.registry)
        self.master_round_trip = Histogram(
            "rosproxy_master_round_trip_seconds",
            "Duration of the proxy's own calls to the master, in seconds.",
            registry=self.registry,
            buckets=(0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 1, 5),
        )

    def count(self, api: str, method: str, outcome: str) -> None:
        """Count a call; unknown method names share one label."""
        label = method if method in self.known_methods else "other"
        self._of_calls(api, label, outcome).inc()
