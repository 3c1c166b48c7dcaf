"""Decides which parts of a cluster the next look plans.

A part is due after a change, or at a time that the last plan has set. Every ``resync`` seconds all
parts are due, so a missed change has an effect then.
"""

from collections.abc import Iterable

from rosproxy_operator.kubernetes.planner.partition import Partition, partition_of
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot


class PlanSchedule:
    """The times at which namespaces are due. All times are seconds of a monotonic clock."""

    def __init__(self) -> None:
        self._due_times: dict[str, float] = {}
        self._all_due = True
        self._last_full_plan_at = 0.0

    def mark_all_due(self) -> None:
        """Make everything due."""
        self._all_due = True

    def mark_due_now(self, namespaces: Iterable[str]) -> None:
        """Make these namespaces due now."""
        self.mark_due_at(namespaces, 0.0)

    def mark_due_at(self, namespaces: Iterable[str], at: float) -> None:
        """Make these namespaces due at a time, unless an earlier time is set."""
        for namespace in namespaces:
            self._due_times[namespace] = min(self._due_times.get(namespace, at), at)

    def is_all_due(self, now: float, resync: float) -> bool:
        """Whether everything is due: by `mark_all_due`, or after ``resync`` seconds."""
        self._all_due = self._all_due or now - self._last_full_plan_at >= resync
        return self._all_due

    def due_partition(
        self,
        observed: ClusterSnapshot,
        namespaces: Iterable[str],
        nodes: Iterable[str],
        now: float,
    ) -> Partition | None:
        """Return the part that is due, with the given namespaces and nodes; None: all is due."""
        if self._all_due:
            return None
        due = {namespace for namespace, at in self._due_times.items() if at <= now}
        return partition_of(observed, {*namespaces, *due}, nodes)

    def note_plan(
        self, scope: Partition | None, observed: ClusterSnapshot, again_in: float | None, now: float
    ) -> None:
        """Note that ``scope`` was planned at ``now``; None: everything.

        The planned namespaces are due again in ``again_in`` seconds; None: after a change.
        """
        if scope is None:
            self._all_due = False
            self._last_full_plan_at = now
            self._due_times = {}
            planned = {rosproxy.id.namespace for rosproxy in observed.rosproxies}
            planned |= {proxy.of.namespace for proxy in observed.proxies}
            planned |= {pod.id.namespace for pod in observed.unselected_pods}
        else:
            planned = {*scope.namespaces}
            for namespace in planned:
                self._due_times.pop(namespace, None)
        if again_in is not None:
            self.mark_due_at(planned, now + again_in)

    def again_in(self, now: float, delay: float | None) -> float | None:
        """Return the seconds until a namespace is due, at most ``delay``; None: no time is set."""
        delays = [max(at - now, 0.0) for at in self._due_times.values()]
        return min([*delays, *([] if delay is None else [delay])], default=None)
