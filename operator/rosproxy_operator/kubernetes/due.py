"""Which parts of a cluster are due to be planned: those that something has happened to.

All of them are every few seconds in any case (``resync``): whatever was missed is found then.
"""

from collections.abc import Iterable

from rosproxy_operator.kubernetes.planner.parts import Part, part_of
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot


class Due:
    """When which namespace is to be planned again, in seconds of a monotonic clock."""

    def __init__(self) -> None:
        self._at: dict[str, float] = {}
        self._all, self._all_at = True, 0.0

    def all(self) -> None:
        """Everything is due."""
        self._all = True

    def at_once(self, namespaces: Iterable[str]) -> None:
        """These are due."""
        self.soon(namespaces, 0.0)

    def soon(self, namespaces: Iterable[str], at: float) -> None:
        """These are due at a time, if not before."""
        for namespace in namespaces:
            self._at[namespace] = min(self._at.get(namespace, at), at)

    def is_all(self, now: float, resync: float) -> bool:
        """Whether everything is due."""
        self._all = self._all or now - self._all_at >= resync
        return self._all

    def part(
        self,
        observed: ClusterSnapshot,
        namespaces: Iterable[str],
        nodes: Iterable[str],
        now: float,
    ) -> Part | None:
        """The part to be planned now; None if it is all. What has changed is due as well."""
        if self._all:
            return None
        due = {namespace for namespace, at in self._at.items() if at <= now}
        return part_of(observed, {*namespaces, *due}, nodes)

    def planned(
        self, part: Part | None, observed: ClusterSnapshot, again_in: float | None, now: float
    ) -> None:
        """A part was planned just now, None: all; it wants to be planned again so soon."""
        if part is None:
            self._all, self._all_at, self._at = False, now, {}
            own = {one.id.namespace for one in observed.rosproxies}
            own |= {one.of.namespace for one in observed.proxies}
        else:
            own = {*part.namespaces}
            for namespace in own:
                self._at.pop(namespace, None)
        if again_in is not None:
            self.soon(own, now + again_in)

    def again_in(self, now: float, other: float | None) -> float | None:
        """In how many seconds something is due; None: only if something happens."""
        left = [max(at - now, 0.0) for at in self._at.values()]
        return min([*left, *([] if other is None else [other])], default=None)
