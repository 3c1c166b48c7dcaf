"""Prometheus metrics of the operator."""

import re
from collections import Counter as Tally
from collections.abc import Iterable, Sequence

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
POD_STATES = ("ready", "starting", "stuck")
"""The states of a proxy's pod."""
_BUCKETS = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 20)
_WORD = re.compile(r"(?<!^)(?=[A-Z])")


class CommonMetrics:
    """The metrics for any engine, in a registry of their own.

    ``of`` is what is looked at, by the gauge ``up`` whether it answers; ``on`` what is acted on;
    ``states`` those that a proxy can be in.
    """

    def __init__(self, of: str, on: str, states: Sequence[str], up: str) -> None:
        self.registry = registry = CollectorRegistry()
        self._states = states
        ProcessCollector(registry=registry)
        build = Info("rosproxy_operator_build", "The operator's version.", registry=registry)
        build.info({"version": __version__})
        self.looks = self.counter(
            "looks", f"Looks at the {of} by outcome (ok, unavailable, failed).", "outcome"
        )
        self.look_time = Histogram(
            "rosproxy_operator_look_seconds",
            "Time for a look: listing everything and planning.",
            registry=registry,
            buckets=_BUCKETS,
        )
        self.actions = self.counter(
            "actions",
            f"What was done to the {on} by action and outcome (ok, failed, taken: a port was).",
            "action",
            "outcome",
        )
        self.up = self.gauge(up, f"Whether the {of} answers.")
        self.problems = self.gauge("problems", "Problems that are there now.")
        self.proxies = self.gauge("proxies", "Proxies by state.", "state")

    def show_proxies(self, states: Iterable[str]) -> None:
        """Set the number of proxies in each state."""
        tally = Tally(states)
        for state in self._states:
            self.proxies.labels(state).set(tally[state])

    def count(self, action: object, outcome: str) -> None:
        """Count an action, named after its class."""
        word = _WORD.sub("_", type(action).__name__).lower()
        self.actions.labels(word, outcome).inc()

    def counter(self, name: str, text: str, *labels: str) -> Counter:
        """A new counter."""
        return Counter(f"rosproxy_operator_{name}", text, labels, registry=self.registry)

    def gauge(self, name: str, text: str, *labels: str) -> Gauge:
        """A new gauge."""
        return Gauge(f"rosproxy_operator_{name}", text, labels, registry=self.registry)


class DockerMetrics(CommonMetrics):
    """All metrics for a Docker host."""

    def __init__(self) -> None:
        super().__init__("engine", "host", STATES, up="engine_up")
        self.containers = self.gauge("containers", "Containers that a proxy is there for.")


class ClusterMetrics(CommonMetrics):
    """All metrics for a cluster."""

    def __init__(self) -> None:
        super().__init__("API server", "cluster", POD_STATES, up="api_up")
        self.rosproxies = self.gauge("rosproxies", "RosProxies that can be read.")
        self.pods = self.gauge("pods", "Running pods that a RosProxy selects.")
        self.admissions = self.counter(
            "admissions", "Pods at admission by outcome (wired, left, failed).", "outcome"
        )
        self.certificate_expiry = self.gauge(
            "certificate_expiry_seconds",
            "When the admission webhook's certificate expires, in seconds of Unix time.",
        )
        self.watch_restarts = self.counter(
            "watch_restarts", "How often watching had to be started anew; looks go on meanwhile."
        )
