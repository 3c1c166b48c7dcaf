"""Which data plane a proxy gets, where its containers may ask for different ones."""

from collections.abc import Iterable, Iterator

from rosproxy.settings import DataPlane
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.docker.planner.label_values import DATA_PLANE
from rosproxy_operator.docker.planner.model import Desired, Member

_FIRST: tuple[DataPlane, ...] = ("kernel", "splice", "copy", "auto")
"""Who asks for what the proxy can't do by itself goes first."""


def chosen(members: Iterable[Member], default: DataPlane) -> DataPlane:
    """The data plane of a proxy with these containers; ``default`` if none asks for one."""
    asked = {member.data_plane for member in members}
    return next((plane for plane in _FIRST if plane in asked), default)


def outvoted(desired: Iterable[Desired]) -> Iterator[Problem]:
    """Tell the containers that share a proxy with one that asks for something else."""
    for one in desired:
        for member in one.members:
            if member.data_plane not in (None, one.data_plane):
                yield Problem(f"container {member.container}", _text(member, one), fatal=False)


def _text(member: Member, one: Desired) -> str:
    other = next(
        (w.container for w in one.members if w.data_plane == one.data_plane), "another one"
    )
    return (
        f"label {DATA_PLANE}={member.data_plane} is ignored: its proxy also serves {other}, which "
        f"asks for {one.data_plane}; give both the same"
    )
