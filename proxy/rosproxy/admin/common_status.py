"""The part of ``/status`` that every proxy has; `ros1`, `ros2` and `zenoh` add their parts."""

import os
import time
from collections.abc import Sequence

from msgspec.structs import replace

from rosproxy import __version__
from rosproxy.runtime import Runtime
from rosproxy.shared.documents.status_document import (
    HiddenStatus,
    LayerStatus,
    PolicyStatus,
    PortsStatus,
    ProblemStatus,
    ProxyStatus,
    StatusSettings,
)
from rosproxy.shared.output.problems import Problems

MOST_HIDDEN = 2000
"""Hidden names that the status lists for each version of ROS, with fair shares by address.

The reason for the bound: the search for the rule that hides a name takes up to some microseconds.
"""


def common_status(runtime: Runtime) -> ProxyStatus:
    """The state of a proxy, without the parts of ROS 1, ROS 2 and rmw_zenoh."""
    settings = runtime.settings
    ports = settings.ports
    return ProxyStatus(
        version=__version__,
        pid=os.getpid(),
        instance=runtime.instance,
        uptime=round(runtime.uptime(), 1),
        settings=StatusSettings(
            ros=settings.ros,
            advertise_host=settings.advertise_host,
            bind=settings.bind,
            direction=settings.direction,
        ),
        ports=(
            PortsStatus(str(ports.listen), str(ports.advertise))
            if settings.range_versions
            else PortsStatus()
        ),
        policy=_policy(runtime),
        problems=_problems(runtime.problems),
    )


def with_hidden(
    policy: PolicyStatus | None, hidden: Sequence[HiddenStatus], left_out: int
) -> PolicyStatus:
    """Add ``hidden`` names to the policy, and the number of further names that are left out."""
    policy = policy or PolicyStatus()
    every = (*policy.hidden, *hidden)
    return replace(policy, hidden=every, left_out=policy.left_out + left_out)


def _policy(runtime: Runtime) -> PolicyStatus:
    return PolicyStatus(
        tuple(
            LayerStatus(
                layer.name,
                layer.mode.value,
                tuple(map(str, layer.rules)),
                None if layer.addresses is None else len(layer.addresses),
            )
            for layer in runtime.policy.layers
        )
    )


def _problems(problems: Problems) -> tuple[ProblemStatus, ...]:
    """The noted problems, with their ages."""
    now = time.time()
    return tuple(
        ProblemStatus(_age(p.when, now), p.subject, p.text, p.holds, _age(p.since, now))
        for p in problems.all()
    )


def _age(when: float, now: float) -> float:
    # Readers refuse an age below 0 (`Seconds`), but the clock may have been set back meanwhile.
    return round(max(now - when, 0.0), 1)
