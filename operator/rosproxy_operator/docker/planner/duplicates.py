"""Which of several containers for one thing stays, and which goes.

There are several when settings have changed and one is to take over from another, when the operator
was killed in between, or when somebody has meddled.
"""

from collections.abc import Collection, Iterable
from dataclasses import dataclass

from rosproxy_operator.docker.planner.model import SERVING, Container, OwnContainer

IDLE = frozenset({"created", "exited"})
"""States of a container that can be started; a dead one can't."""


@dataclass(frozen=True, slots=True)
class Selection:
    """What is to become of the containers for one thing.

    ``kept`` is as it ought to be, running or not; None if one is to be created. ``predecessor``
    serves, or has served, until that one takes over. ``surplus`` are left over. ``waiting``: one is
    just being removed, so nothing can be created, removed or started. ``stuck``: one ought to be
    created but can't.
    """

    kept: Container | None = None
    predecessor: Container | None = None
    surplus: tuple[Container, ...] = ()
    waiting: bool = False
    stuck: bool = False


def select(
    own: Iterable[OwnContainer], name: str, fit_ids: Collection[str], creatable: bool
) -> Selection:
    """Decide which of several containers for one thing stays, and which goes.

    Args:
        own: All that there are for one thing.
        name: What the one that stays is to be called.
        fit_ids: The ids of those that are as they ought to be, and run or can be started.
        creatable: Whether one can be created. If not, one that runs stays as it is.
    """
    containers = sorted((c.container for c in own), key=lambda c: (c.name != name, c.name))
    present = [c for c in containers if c.state != "removing"]
    serving = [c for c in present if c.state in SERVING]
    best = min(serving, key=lambda c: c.id not in fit_ids, default=None)
    if len(present) < len(containers):
        return Selection(kept=best, waiting=True)
    idle = [c for c in present if c.state in IDLE]
    ready = next((c for c in idle if c.id in fit_ids), None)
    kept = None
    old = best or next(iter(idle), None)
    if best and (best.id in fit_ids or not creatable):
        kept = best
        old = None
    elif ready:
        kept = ready
        old = best
    elif not creatable:
        return Selection(stuck=True)
    return Selection(kept, old, tuple(c for c in present if c not in (kept, old)))


def free_name(name: str, taken: Collection[str]) -> str:
    """The name, with a number behind it if it is taken."""
    number = 1
    while (free := name if number == 1 else f"{name}-{number}") in taken:
        number += 1
    return free
