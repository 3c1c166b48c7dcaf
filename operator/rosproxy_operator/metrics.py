"""Prometheus metrics of a controller."""

from collections import Counter as Tally
from collections.abc import Iterable

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    Info,
    ProcessCollector,
)

from rosproxy import __version__

STATES = ("created", "restarting", "running", "paused", "exited", "dead", "removing")
"""The states of a container, in the engine's words."""
_BUCKETS = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 20)


class Metrics:
    """All metrics of a controller, in a registry of their own."""

    def __init__(self) -> None:
        self.registry = registry = CollectorRegistry()
        ProcessCollector(registry=registry)
        build = Info("rosproxy_controller_build", "The controller's version.", registry=registry)
        build.info({"version": __version__})
        self.looks = Counter(
            "rosproxy_controller_looks",
            "Looks at the engine by outcome (ok, unavailable, failed).",
            ["outcome"],
            registry=registry,
        )
        self.look_time = Histogram(
            "rosproxy_controller_look_seconds",
            "Time for a look: listing everything and planning.",
            registry=registry,
            buckets=_BUCKETS,
        )
        self.actions = Counter(
            "rosproxy_controller_actions",
            "What was done to the host by action and outcome (ok, failed, taken: a port was).",
            ["action", "outcome"],
            registry=registry,
        )
        self.containers = self._gauge("containers", "Containers that a proxy is there for.")
        self.problems = self._gauge("problems", "Problems that are there now.")
        self.engine_up = self._gauge("engine_up", "Whether the engine answers.")
        self.proxies = Gauge(
            "rosproxy_controller_proxies",
            "Proxy containers by state.",
            ["state"],
            registry=registry,
        )

    def show_proxies(self, states: Iterable[str]) -> None:
        """Set the number of proxies in each state."""
        tally = Tally(states)
        for state in STATES:
            self.proxies.labels(state).set(tally[state])

    def _gauge(self, name: str, text: str) -> Gauge:
        return Gauge(f"rosproxy_controller_{name}", text, registry=self.registry)
