"""The part for ROS 2 as a whole: what it does with a change of policy."""

from typing import cast

import pytest

from rosproxy.ros2.protocol.rtps import RtpsError
from rosproxy.ros2.servers.domain_server import DomainServer
from rosproxy.ros2.stack import Ros2
from rosproxy.runtime import Runtime
from tests.run_options import parse_settings


class FailingOnce:
    """A domain's server that fails to apply a policy the first time."""

    calls = 0

    def apply_policy(self) -> None:
        self.calls += 1
        if self.calls == 1:
            raise RtpsError("made to fail")


async def test_a_policy_that_could_not_be_applied_is_tried_again() -> None:
    told = {"ros": ("2",), "advertise_host": "192.0.2.1", "port_range": "45000-45015"}
    runtime = Runtime(parse_settings(told))
    ros2, server = Ros2(runtime), FailingOnce()
    ros2.servers.append(cast(DomainServer, server))
    runtime.policy.version += 1
    with pytest.raises(RtpsError):
        await ros2._look_at_policy()
    await ros2._look_at_policy()
    await ros2._look_at_policy()
    assert server.calls == 2
