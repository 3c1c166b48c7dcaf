"""What is to be done for the ear of a proxy for ROS 2.

The ear is in the host's network: it hears the LAN's multicast there, and the proxy at the uplink's
gateway, at the last of the ports that are held for the proxy, which is not published. It has to
know the proxy's address, so it is made once the sandbox has one, and anew when that is another.
"""

from collections.abc import Collection, Iterator

from msgspec.structs import replace

from rosproxy.net.addresses import HostPort, is_address
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.docker.option_values import NOWHERE
from rosproxy_operator.docker.planner.actions import (
    Action,
    CreateEar,
    CreateSandbox,
    Remove,
    Rename,
    Start,
)
from rosproxy_operator.docker.planner.container_steps import (
    PlanContext,
    creation_steps,
    former_name,
    keep_running_steps,
)
from rosproxy_operator.docker.planner.duplicates import free_name
from rosproxy_operator.docker.planner.model import HostState, Key
from rosproxy_operator.docker.planner.specs import ear_fingerprint, ear_name, proxy_name
from rosproxy_operator.docker.settings import PlanSettings


def with_ear(context: PlanContext, steps: list[Action]) -> list[Action]:
    """The steps for a proxy, and if it is for ROS 2 those for its ear.

    Before a sandbox is started the ear goes: its port may become one that is published.
    """
    key = context.desired.key
    if not key.is_ros2:
        return steps
    sandboxes = {s.container.name for s in context.observed.sandboxes_of(key)}
    if any(_starts(step, sandboxes) for step in steps):
        return [*_without(context, "its proxy gets another address"), *steps]
    return [*steps, *_ear_steps(context)]


def missing_ear(key: Key, observed: HostState, settings: PlanSettings) -> Problem | None:
    """Why a proxy for ROS 2 has no ear though it ought to."""
    if settings.ros2_lan == NOWHERE or _lan(key, observed, settings) or observed.ears_of(key):
        return None
    text = (
        "does not hear the LAN, since this host's address there is not known: start the operator "
        f"with --ros2-lan ADDRESS, or with --ros2-lan {NOWHERE} if peers are enough"
    )
    return Problem(f"proxy {proxy_name(key)}", text, fatal=False)


def _starts(step: Action, sandboxes: Collection[str]) -> bool:
    """Whether a sandbox, one of these or a new one, begins or ends by a step."""
    begins = isinstance(step, Start | Remove) and step.name in sandboxes
    return begins or isinstance(step, CreateSandbox)


def _lan(key: Key, observed: HostState, settings: PlanSettings) -> str:
    """This host's address on the LAN; empty if there is none, or it is not known."""
    if settings.ros2_lan:
        return "" if settings.ros2_lan == NOWHERE else settings.ros2_lan
    return key.advertise_host if is_address(key.advertise_host) else observed.far


def _wanted(context: PlanContext) -> CreateEar | None:
    """The ear that there ought to be; None if there ought to be none, or its proxy is not found."""
    key = context.desired.key
    observed = context.observed
    settings = context.settings
    lan = _lan(key, observed, settings)
    bind = context.ear
    address = next(
        (
            attachment.address
            for sandbox in observed.sandboxes_of(key)
            for attachment in sandbox.container.attachments
            if attachment.network == settings.uplink and attachment.address
        ),
        "",
    )
    if not lan or not address or bind is None:
        return None
    proxy = HostPort(address, context.ports.first)
    return CreateEar(ear_name(key), key, context.ports, lan, bind, proxy)


def _ear_steps(context: PlanContext) -> Iterator[Action]:
    ear = _wanted(context)
    if context.settings.ros2_lan == NOWHERE:
        yield from _without(context, "the LAN is not to be heard")
    # Where an address is not known now, the ear that is there stays as it is.
    elif ear is not None:
        yield from _ensure_ear(context, ear)


def _ensure_ear(context: PlanContext, ear: CreateEar) -> Iterator[Action]:
    """The steps to have this ear and no other."""
    ears = context.observed.ears_of(ear.key)
    observed = context.observed
    expected = ear_fingerprint(ear, context.settings, observed.image_id, observed.secret)
    selection = context.select(ears, ear.name, expected, lambda _: True)
    if selection.stuck or selection.waiting:
        return
    yield from (Remove(container.name, "left over") for container in selection.surplus)
    taken = context.taken(ears)
    if selection.kept is None:
        ear = replace(ear, name=free_name(ear.name, taken), fingerprint=expected)
        yield from creation_steps(
            selection, ear, former_name(selection.predecessor, ear.name, taken)
        )
        return
    yield from keep_running_steps(selection, selection.kept)
    if ear.name not in (selection.kept.name, *taken):
        yield Rename(selection.kept.name, ear.name)


def _without(context: PlanContext, reason: str) -> Iterator[Action]:
    for ear in context.observed.ears_of(context.desired.key):
        if ear.container.state != "removing":
            yield Remove(ear.container.name, reason)
