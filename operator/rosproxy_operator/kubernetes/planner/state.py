"""What the controller remembers from look to look. Losing it costs time, never correctness."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from rosproxy.leases.ports import PortRange
from rosproxy_operator.common.moves import Move
from rosproxy_operator.kubernetes.planner.model import Finding, Name
from rosproxy_operator.kubernetes.planner.retries import Task, Try


@dataclass(frozen=True, slots=True, order=True)
class Place:
    """A node, as one RosProxy (``of``) sees it."""

    of: Name
    node: str


@dataclass(frozen=True, slots=True)
class Memory:
    """Times are in seconds of the controller's monotonic clock.

    ``begun`` is False until the first look. ``absent`` are proxies since when no pod wants them,
    ``lost`` nodes since when they are not listed any more. ``served`` is the range on which a
    proxy was last seen to serve, ``given`` the one that it is to have. ``refused`` is since when a
    proxy that has served does not get its ports back; ``taken`` are ports by node that were refused
    at last, and when; ``moved`` are the ranges that had to be left, ``tried`` those that could not
    be had in the first place. ``tries`` are actions that have not shown an effect yet, ``seen``
    problems that Events were made of. ``addresses`` are, by node, those that pods have or
    had, and when they were last seen to; ``strange``, by node and address, those that a proxy has
    named and that no pod was seen with, since when.
    """

    begun: bool = False
    absent: Mapping[Place, float] = field(default_factory=dict)
    lost: Mapping[str, float] = field(default_factory=dict)
    served: Mapping[Place, PortRange] = field(default_factory=dict)
    given: Mapping[Place, PortRange] = field(default_factory=dict)
    refused: Mapping[Place, float] = field(default_factory=dict)
    taken: Mapping[tuple[str, int], float] = field(default_factory=dict)
    moved: Mapping[Place, Move] = field(default_factory=dict)
    tried: Mapping[Place, Move] = field(default_factory=dict)
    tries: Mapping[Task, Try] = field(default_factory=dict)
    seen: Mapping[Finding, float] = field(default_factory=dict)
    addresses: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    strange: Mapping[tuple[str, str], float] = field(default_factory=dict)
