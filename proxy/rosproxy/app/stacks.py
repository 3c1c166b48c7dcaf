"""The stacks of a proxy: ROS 1, ROS 2 and rmw_zenoh.

Only `make_stacks` names the stacks. The process, the policy sources, the self-check and the admin
endpoint use the protocol `Stack`.
"""

from collections.abc import Mapping
from typing import Protocol

from rosproxy.admin.admin_server import Action
from rosproxy.ros1.stack import Ros1
from rosproxy.ros2.stack import Ros2
from rosproxy.runtime import Runtime
from rosproxy.shared.documents.requests import EnforcementCounts, PortProbe
from rosproxy.shared.documents.status_document import ProxyStatus
from rosproxy.zenoh.stack import Zenoh


class Stack(Protocol):
    """The part of a proxy for ROS 1, ROS 2 or rmw_zenoh."""

    @property
    def greeting(self) -> str:
        """How nodes use the stack, for the line ``listening`` in the log."""

    @property
    def actions(self) -> Mapping[str, Action]:
        """The POST actions of the admin endpoint, by path."""

    @property
    def retired(self) -> bool:
        """Whether the stack was retired (``POST /retire``), and registers nothing any more."""

    async def start(self) -> None:
        """Bind all ports, and start. Raises SettingError if a necessary port is taken."""

    async def stop(self) -> None:
        """Stop the stack, and all tasks of the runtime."""

    async def settle(self) -> None:
        """Wait until `probe` gives useful results, for example until the master answers."""

    async def probe(self, or_fast: bool) -> tuple[PortProbe, ...]:
        """Test whether outside reaches some ports; without results if nothing could be tried.

        ``or_fast``: if no port is free, ROS 1 tries a fast port (`probe_range`).
        """

    async def try_ports(self) -> tuple[PortProbe, ...]:
        """Bind all ports, test the ports, and close all, without a start. Raises SettingError."""

    async def apply_policy(self) -> EnforcementCounts:
        """Enforce the current policy on registrations and connections. Raises CallFailed."""

    def unready(self) -> str | None:
        """The reason why nodes can't use the stack now; None if nodes can."""

    def extended_status(self, status: ProxyStatus) -> ProxyStatus:
        """A copy of ``status`` with the parts of this stack."""


def make_stacks(runtime: Runtime) -> tuple[Stack, ...]:
    """The stacks that the settings ask for."""
    stacks: list[Stack] = []
    if runtime.settings.for_ros1:
        stacks.append(Ros1(runtime))
    if runtime.settings.for_ros2:
        stacks.append(Ros2(runtime))
    if runtime.settings.for_zenoh:
        stacks.append(Zenoh(runtime))
    return tuple(stacks)
