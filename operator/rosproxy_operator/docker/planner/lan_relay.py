"""Plan the steps for the LAN relay of a proxy for ROS 2.

The LAN relay runs in the host's network, and receives the multicast of the LAN there. For the
proxy, the LAN relay listens at the gateway of the uplink, at the last port of the proxy's range.
The sandbox does not publish this port. The LAN relay has to know the proxy's address. So the
operator creates the LAN relay after the sandbox has an address, and recreates the LAN relay when
this address changes.
"""

from collections.abc import Collection, Iterator

from msgspec.structs import replace

from rosproxy.shared.addresses import HostPort, is_address
from rosproxy_operator.common.problem import (
    NO_LAN_ADDRESS,
    Problem,
)
from rosproxy_operator.docker.option_values import NOWHERE
from rosproxy_operator.docker.planner.actions import (
    Action,
    CreateLanRelay,
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
from rosproxy_operator.docker.planner.model import HostState
from rosproxy_operator.docker.planner.specs import lan_relay_fingerprint, lan_relay_name, proxy_name
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.place import Domain, Place


def with_lan_relay(context: PlanContext, steps: list[Action]) -> list[Action]:
    """Return the steps for a proxy, for ROS 2 with the steps for the LAN relay.

    If the steps start, create or remove a sandbox, the operator removes the LAN relay first: the
    new sandbox may publish the LAN relay's port. Later looks create the LAN relay again.
    """
    place = context.desired.place
    if not isinstance(place.graph, Domain):
        return steps
    sandboxes = {s.container.name for s in context.observed.sandboxes_of(place)}
    if any(_starts(step, sandboxes) for step in steps):
        return [*_removal_steps(context, "the proxy gets another address"), *steps]
    return [*steps, *_lan_relay_steps(context)]


def missing_lan_relay(place: Place, observed: HostState, settings: PlanSettings) -> Problem | None:
    """Return a warning if a proxy for ROS 2 lacks the LAN relay; None if nothing is missing."""
    if (
        settings.ros2_lan == NOWHERE
        or _lan_address(place, observed, settings)
        or observed.lan_relays_of(place)
    ):
        return None
    return Problem(
        f"proxy {proxy_name(place)}",
        "has no LAN relay, since the operator does not know this host's address on the LAN",
        "Start the operator with --ros2-lan ADDRESS, or with --ros2-lan "
        f"{NOWHERE} if peers are enough",
        fatal=False,
        reason=NO_LAN_ADDRESS,
    )


def _starts(step: Action, sandboxes: Collection[str]) -> bool:
    """Whether a step creates a sandbox, or starts or removes one of ``sandboxes``."""
    begins = isinstance(step, Start | Remove) and step.name in sandboxes
    return begins or isinstance(step, CreateSandbox)


def _lan_address(place: Place, observed: HostState, settings: PlanSettings) -> str:
    """Return this host's address on the LAN; empty if unknown, or if ``--ros2-lan`` is ``none``."""
    if settings.ros2_lan:
        return "" if settings.ros2_lan == NOWHERE else settings.ros2_lan
    return (
        place.advertise_host if is_address(place.advertise_host) else observed.default_route_address
    )


def _creation(context: PlanContext) -> CreateLanRelay | None:
    """Return the action that creates the LAN relay.

    None if the proxy gets no LAN relay, or while an address is unknown: this host's on the LAN, the
    proxy's on the uplink, or the gateway's of the uplink.
    """
    place = context.desired.place
    observed = context.observed
    settings = context.settings
    lan = _lan_address(place, observed, settings)
    bind = context.lan_relay
    address = next(
        (
            attachment.address
            for sandbox in observed.sandboxes_of(place)
            for attachment in sandbox.container.attachments
            if attachment.network == settings.uplink and attachment.address
        ),
        "",
    )
    if not lan or not address or bind is None:
        return None
    proxy = HostPort(address, context.ports.first)
    return CreateLanRelay(lan_relay_name(place), place, context.ports, lan, bind, proxy)


def _lan_relay_steps(context: PlanContext) -> Iterator[Action]:
    lan_relay = _creation(context)
    if context.settings.ros2_lan == NOWHERE:
        yield from _removal_steps(context, f"--ros2-lan is {NOWHERE}")
    # While an address is unknown, an existing LAN relay stays unchanged.
    elif lan_relay is not None:
        yield from _ensure_lan_relay(context, lan_relay)


def _ensure_lan_relay(context: PlanContext, lan_relay: CreateLanRelay) -> Iterator[Action]:
    """Yield the steps after which the proxy has this LAN relay and no other."""
    lan_relays = context.observed.lan_relays_of(lan_relay.place)
    observed = context.observed
    expected = lan_relay_fingerprint(
        lan_relay, context.settings, observed.image_id, observed.secret
    )
    selection = context.select(lan_relays, lan_relay.name, expected, lambda _: True)
    if selection.stuck or selection.waiting:
        return
    yield from (Remove(container.name, "left over") for container in selection.surplus)
    taken = context.taken(lan_relays)
    if selection.kept is None:
        lan_relay = replace(lan_relay, name=free_name(lan_relay.name, taken), fingerprint=expected)
        yield from creation_steps(
            selection, lan_relay, former_name(selection.predecessor, lan_relay.name, taken)
        )
        return
    yield from keep_running_steps(selection, selection.kept)
    if lan_relay.name not in (selection.kept.name, *taken):
        yield Rename(selection.kept.name, lan_relay.name)


def _removal_steps(context: PlanContext, reason: str) -> Iterator[Action]:
    for lan_relay in context.observed.lan_relays_of(context.desired.place):
        if lan_relay.container.state != "removing":
            yield Remove(lan_relay.container.name, reason)
