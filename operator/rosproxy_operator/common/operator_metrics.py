"""Prometheus metrics of the operator."""

import re
from collections import Counter as Tally
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial

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

# prometheus_client adds a series with the start time of each counter. No alert and no dashboard
# uses these series.
disable_created_metrics()  # type: ignore[no-untyped-call]

OUTCOMES = ("ok", "unavailable", "failed")
"""How a look ends."""
CONTAINER_STATES = ("created", "restarting", "running", "paused", "exited", "dead", "removing")
"""The states of a container, as the engine names them."""
POD_STATES = ("ready", "starting", "stuck")
"""The states of a proxy's pod."""
_PREFIX = "rosproxy_operator"
_BUCKETS = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 20)
_BEFORE_CAPITAL = re.compile(r"(?<!^)(?=[A-Z])")


class CommonMetrics:
    """The metrics of both operators, in a separate registry.

    ``source`` names the API that the operator reads. ``up`` is the name of the gauge that says
    whether this API answers. ``site`` is the word for the host or cluster that the operator
    changes. ``states`` are the possible states of a proxy.
    """

    def __init__(self, source: str, site: str, states: Sequence[str], up: str) -> None:
        self.registry = registry = CollectorRegistry()
        self._counter = partial(Counter, namespace=_PREFIX, registry=registry)
        self._gauge = partial(Gauge, namespace=_PREFIX, registry=registry)
        self._states = states
        ProcessCollector(registry=registry)
        Info("build", "The operator's version.", namespace=_PREFIX, registry=registry).info(
            {"version": __version__}
        )
        text = f"Looks at the {source} by outcome (ok, unavailable, failed)."
        self.looks = self._counter("looks", text, ["outcome"])
        for outcome in OUTCOMES:  # Prometheus sees no increase in a series that begins with 1
            self.looks.labels(outcome)
        text = "Duration of a look in seconds: listing everything, and planning."
        self.look_time = Histogram(
            "look_seconds", text, namespace=_PREFIX, registry=registry, buckets=_BUCKETS
        )
        text = f"Actions on the {site} by outcome (ok, failed, taken: the port was in use)."
        self.actions = self._counter("actions", text, ["action", "outcome"])
        self.up = self._gauge(up, f"Whether the {source} answers.")
        self.problems = self._gauge("problems", "Current problems.")
        self.proxies = self._gauge("proxies", "Proxies by state.", ["state"])
        text = "Jobs by state (busy, failed: the operator tries again)."
        self._jobs = self._gauge("jobs", text, ["state"])

    def show_proxies(self, states: Iterable[str]) -> None:
        """Set the number of proxies in each state. ``states`` has the state of every proxy."""
        tally = Tally(states)
        for state in self._states:
            self.proxies.labels(state).set(tally[state])

    def watch_jobs(self, busy: Callable[[], int], failed: Callable[[], int]) -> None:
        """Call ``busy`` and ``failed`` for the numbers of jobs at each reading of the metrics."""
        self._jobs.labels("busy").set_function(busy)
        self._jobs.labels("failed").set_function(failed)

    def count(self, action: object, outcome: str) -> None:
        """Count an action, named after its class."""
        name = _BEFORE_CAPITAL.sub("_", type(action).__name__).lower()
        self.actions.labels(name, outcome).inc()


class DockerMetrics(CommonMetrics):
    """All metrics for a Docker host."""

    def __init__(self) -> None:
        super().__init__("engine", "host", CONTAINER_STATES, up="engine_up")
        self.containers = self._gauge("containers", "Running containers that get a proxy.")


class ClusterMetrics(CommonMetrics):
    """All metrics for a cluster."""

    def __init__(self) -> None:
        super().__init__("API server", "cluster", POD_STATES, up="api_up")
        self.rosproxies = self._gauge("rosproxies", "RosProxies that the operator can read.")
        self.pods = self._gauge("pods", "Running pods that a RosProxy selects.")
        text = "ROS 2 participants behind the proxies, by domain."
        self.participants = self._gauge("participants", text, ["domain"])
        text = "Pods at admission by outcome (wired, left, failed)."
        self.admissions = self._counter("admissions", text, ["outcome"])
        text = "When the admission webhook's certificate expires, in seconds of Unix time."
        self.certificate_expiry = self._gauge("certificate_expiry_seconds", text)
        text = "Whether this operator leads. Of several operators, only the leader acts."
        self.leader = self._gauge("leader", text)
        text = "Changes of the leader that this operator has seen."
        self.leader_changes = self._counter("leader_changes", text)
        text = "Watches that were lost, or had to begin again."
        self.watch_restarts = self._counter("watch_restarts", text)
        text = "Objects for which a full list differed from the reports of the watches."
        self.view_corrections = self._counter("view_corrections", text)

    def show_participants(self, domains: Mapping[int, int]) -> None:
        """Set the number of participants in each domain that has a proxy."""
        self.participants.clear()
        for domain, count in domains.items():
            self.participants.labels(str(domain)).set(count)
