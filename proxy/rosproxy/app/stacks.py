"""The versions of ROS that a proxy is for, and what it knows of each of them.

This is where one is plugged in: everything else here, and the admin endpoint, knows a `Stack`.
"""

from collections.abc import Mapping
from typing import Protocol

from rosproxy.admin.admin_server import Action
from rosproxy.admin.requests import EnforcementCounts, PortProbe
from rosproxy.admin.status_document import ProxyStatus
from rosproxy.ros1.stack import Ros1
from rosproxy.ros2.stack import Ros2
from rosproxy.runtime import Runtime
from rosproxy.zenoh.stack import Zenoh


class Stack(Protocol):
    """One version of ROS in a proxy."""

    @property
    def greeting(self) -> str:
        """How nodes use it, for the log."""

    @property
    def actions(self) -> Mapping[str, Action]:
        """What posts at the admin endpoint do, by their paths."""

    @property
    def retired(self) -> bool:
        """Whether it has ended its work, and registers nothing any more."""

    async def start(self) -> None:
        """Bind all ports and begin. Raises SettingError if one is taken that has to be had."""

    async def stop(self) -> None:
        """End everything, and all tasks."""

    async def settle(self) -> None:
        """Wait until its ports can be probed."""

    async def probe(self, or_fast: bool) -> tuple[PortProbe, ...]:
        """How some of its ports are reached from outside; ``or_fast``: see `probe_range`."""

    async def try_ports(self) -> tuple[PortProbe, ...]:
        """Instead of a start: take all ports, probe them, and let go. Raises SettingError."""

    async def apply_policy(self) -> EnforcementCounts:
        """Make everything fit the policy. Raises CallFailed."""

    def unready(self) -> str | None:
        """Why nodes can't use it now; None if they can."""

    def add_to(self, status: ProxyStatus) -> ProxyStatus:
        """The status of the proxy, with what there is to tell of this version of ROS."""


def make_stacks(runtime: Runtime) -> tuple[Stack, ...]:
    """Those that the settings ask for."""
    stacks: list[Stack] = []
    if runtime.settings.for_ros1:
        stacks.append(Ros1(runtime))
    if runtime.settings.for_ros2:
        stacks.append(Ros2(runtime))
    if runtime.settings.for_zenoh:
        stacks.append(Zenoh(runtime))
    return tuple(stacks)
