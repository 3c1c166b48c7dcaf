"""What ROS 1, ROS 2 and rmw_zenoh share in a running proxy: settings, clock, tasks, reports.

The process creates the runtime once, before the stacks.
"""

import asyncio
import uuid
from collections.abc import Callable

from rosproxy.access.access_policy import AccessPolicy
from rosproxy.shared.output.problems import Problems
from rosproxy.shared.settings import Settings
from rosproxy.shared.tasks import Tasks
from rosproxy.telemetry.metrics import Metrics
from rosproxy.telemetry.refusals import Refusals


class Runtime:
    """The shared objects of a proxy. Needs a running event loop.

    ``instance`` is a random name of this process. ``refusals`` reports refusals above a bound.
    ``policy``: what outside may see and do. ``now`` returns seconds of the event loop's monotonic
    clock, which timers use, too. ``outside_changed``: set the event when the last proof that
    outside reaches the range may no longer hold. The proxy then tests again.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.instance = uuid.uuid4().hex
        self.now: Callable[[], float] = asyncio.get_running_loop().time
        self._started = self.now()
        self.metrics = Metrics()
        self.tasks = Tasks()
        self.problems = Problems()
        self.outside_changed = asyncio.Event()
        self.refusals = Refusals(self.metrics, self.problems, self.now)
        self.policy = AccessPolicy(
            settings.policy, settings.policy_layers, self.metrics, self.refusals
        )

    def uptime(self) -> float:
        """Seconds since the start of the proxy."""
        return self.now() - self._started
