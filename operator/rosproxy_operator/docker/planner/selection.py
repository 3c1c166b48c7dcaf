"""Which of several containers for one thing stays, and which goes.

There are several when settings have changed and one is to take over from another, when a
operator was killed in between, or when somebody has meddled.
"""

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass

from rosproxy_operator.docker.planner.model import Container
from rosproxy_operator.docker.planner.state import SERVING

IDLE = frozenset({"created", "exited"})
"""States of a container that can be started; a dead one can't."""


@dataclass(frozen=True, slots=True)
class Selection:
    """What is to become of the containers for one thing.

    ``kept`` is as it ought to be, running or not; None if one is to be created. ``old`` serves, or
    has served, until that one takes over. ``others`` are left over. ``waiting``: one is just being
    removed, so nothing can be created, removed or started. ``stuck``: one ought to be created but
    can't.
    """

    kept: Container | None = None
    old: Container | None = None
    others: tuple[Container, ...] = ()
    waiting: bool = False
    stuck: bool = False


def select(
    containers: Iterable[Container],
    name: str,
    right: Callable[[Container], bool],
    usable: Callable[[Container], bool],
    creatable: bool,
) -> Selection:
    """Decide who stays.

    Args:
        containers: All that there are for one thing.
        name: What the one that stays is to be called.
        right: Whether one is as it would be created now.
        usable: Whether one that has stopped can be started.
        creatable: Whether one can be created. If not, one that runs stays as it is.
    """
    every = sorted(containers, key=lambda one: (one.name != name, one.name))
    there = [one for one in every if one.state != "removing"]
    serving = sorted((one for one in there if one.state in SERVING), key=lambda one: not right(one))
    idle = [one for one in there if one.state in IDLE]
    ready = [one for one in idle if right(one) and usable(one)]
    best = serving[0] if serving else None
    if len(there) < len(every):
        return Selection(kept=best, waiting=True)
    if best and (right(best) or not creatable):
        return _with(there, best, None)
    if ready:
        return _with(there, ready[0], best)
    if creatable:
        return _with(there, None, best or (idle[0] if idle else None))
    return Selection(stuck=True)


def free_name(name: str, taken: Collection[str]) -> str:
    """The name, with a number behind it if it is taken."""
    number = 1
    while (found := name if number == 1 else f"{name}-{number}") in taken:
        number += 1
    return found


def _with(there: Iterable[Container], kept: Container | None, old: Container | None) -> Selection:
    return Selection(kept, old, tuple(one for one in there if one not in (kept, old)))
