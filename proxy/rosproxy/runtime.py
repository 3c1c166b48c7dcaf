"""What all parts of a running proxy share, of ROS 1 and of ROS 2: clock, tasks, what is told.

Made once, before the parts.
"""

import asyncio
import uuid

from rosproxy.access.access_policy import AccessPolicy
from rosproxy.net.tasks import Tasks
from rosproxy.settings import Settings
from rosproxy.telemetry.metrics import Metrics
from rosproxy.telemetry.problems import Problems
from rosproxy.telemetry.refusals import Refusals


class Runtime:
    """The tools of one proxy; needs a running event loop.

    ``instance`` is a random name of this process. ``refusals`` tells what is over some bound;
    ``policy``: what outside may see and do. ``outside_changed`` is to be set when what was proven
    of the way from outside may not hold any more.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.instance = uuid.uuid4().hex
        self._loop = asyncio.get_running_loop()
        self._started = self.now()
        self.metrics = Metrics()
        self.tasks = Tasks()
        self.problems = Problems()
        self.outside_changed = asyncio.Event()
        self.refusals = Refusals(self.metrics, self.problems, self.now)
        self.policy = AccessPolicy(
            settings.policy, settings.policy_layers, self.metrics, self.refusals
        )

    def now(self) -> float:
        """Seconds of the event loop's clock, which never goes back: timers go by the same."""
        return self._loop.time()

    def uptime(self) -> float:
        """Seconds since it was made."""
        return self.now() - self._started
