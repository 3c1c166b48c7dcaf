"""Decide which of several containers in the same role stays, and which goes.

A role is the sandbox, the proxy or the LAN relay of a place. Several containers have the same role
while a new container takes over. The reason may also be an operator that was killed, or a change by
a user.
"""

from collections.abc import Collection, Iterable
from dataclasses import dataclass

from rosproxy_operator.docker.planner.model import SERVING, Container, OwnContainer

IDLE = frozenset({"created", "exited"})
"""States in which a container can be started. A dead container can't be started."""


@dataclass(frozen=True, slots=True)
class Selection:
    """What happens to the containers of a role.

    ``kept`` is the container that stays, running or not; None if a container has to be created.
    ``predecessor`` is the container that the kept or the new container replaces: a running one, or
    else an idle one. ``surplus`` are all other containers. ``waiting``: the engine is removing a
    container, so nothing can be created, removed or started. ``stuck``: a container is missing and
    can't be created.
    """

    kept: Container | None = None
    predecessor: Container | None = None
    surplus: tuple[Container, ...] = ()
    waiting: bool = False
    stuck: bool = False


def select(
    own: Iterable[OwnContainer], name: str, fit_ids: Collection[str], creatable: bool
) -> Selection:
    """Decide which container of a role stays, and which goes.

    Args:
        own: All containers of the role.
        name: The name for the container that stays.
        fit_ids: The ids of containers that are as planned, and that run or can be started.
        creatable: Whether a container can be created. If not, a running container stays as it is.
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
    """Return the name, with a number from 2 on at the end if the name is taken."""
    number = 1
    while (free := name if number == 1 else f"{name}-{number}") in taken:
        number += 1
    return free
