"""What is to be done for a sandbox: the container that holds a proxy's ports and networks.

The order is such that the operator may be killed after any step: what it leaves is recognised and
finished, and nothing that runs goes before what takes over has been created.

Networks are joined after the start: an engine that starts a container with several networks joins
them in any order, and may lay the published ports over one and then move them to the uplink.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from rosproxy_operator.docker.planner.actions import (
    Action,
    Connect,
    CreateSandbox,
    Disconnect,
    Remove,
    Rename,
    SandboxSpec,
    Start,
    Unpause,
)
from rosproxy_operator.docker.planner.aliases import holds, needed_by
from rosproxy_operator.docker.planner.context import (
    PlanContext,
    former_name,
    inhabitants,
    named,
    removed,
    stopped,
)
from rosproxy_operator.docker.planner.model import Attachment, Container, Desired, HostState
from rosproxy_operator.docker.planner.selection import Selection, free_name, select
from rosproxy_operator.docker.planner.specs import sandbox_fingerprint, sandbox_name
from rosproxy_operator.docker.planner.state import SERVING

_CHANGEABLE = frozenset({"created", "running", "paused", "exited"})


@dataclass(frozen=True, slots=True)
class Home:
    """The sandbox in which a proxy is to run.

    ``id`` is empty if it is yet to be created. ``starts``: the steps start it, so that a proxy
    which was in it must be started anew; else ``started_at`` is when it was.
    """

    name: str
    id: str = ""
    starts: bool = False
    started_at: str = ""


@dataclass(frozen=True, slots=True)
class SandboxSteps:
    """The actions for a sandbox, and which one it is then; None if none is going to run.

    ``stuck``: one ought to be created but can't.
    """

    actions: tuple[Action, ...] = ()
    home: Home | None = None
    stuck: bool = False


def sandbox_steps(context: PlanContext) -> SandboxSteps:
    """The next actions for the sandbox of a key that is wanted."""
    forwards = _forwards(context)
    expected = sandbox_fingerprint(context.key, context.ports, context.settings, forwards)
    right = {
        one.container.id
        for one in context.sandboxes
        if one.range == context.ports and (not context.creatable or one.fingerprint == expected)
    }
    found = select(
        (one.container for one in context.sandboxes),
        sandbox_name(context.key),
        right=lambda container: container.id in right,
        usable=lambda container: startable(context.observed, container),
        creatable=context.creatable,
    )
    kept = found.kept
    if kept and kept.state in SERVING:
        return _running(context, found, kept)
    if kept:
        home = Home(_name_after(context, kept), kept.id, starts=True)
        return SandboxSteps(tuple(_started(context, found, kept)), home)
    if found.waiting or found.stuck:
        return SandboxSteps(stuck=found.stuck)
    name = free_name(sandbox_name(context.key), _others(context))
    spec = SandboxSpec(
        name, context.key, context.ports, expected, context.settings.uplink, forwards
    )
    return SandboxSteps(tuple(_created(context, found, spec)), Home(name, starts=True))


def _forwards(context: PlanContext) -> bool:
    """Whether the kernel is to forward in the sandbox.

    One where it did is not used without: a proxy that was killed has left its rules there, and one
    without the capability can't take them away.
    """
    return context.desired.data_plane == "kernel"


def leave(
    observed: HostState, desired: Desired, containers: tuple[Container, ...], uplink: str
) -> tuple[Disconnect, ...]:
    """Take sandboxes off the networks on which nobody wants them any more."""
    return tuple(
        Disconnect(container.name, network)
        for container in containers
        if container.state in _CHANGEABLE
        for network in _joined(observed, container)
        if network not in desired.networks | {uplink}
    )


def startable(observed: HostState, container: Container) -> bool:
    """Whether the engine can start a container that has stopped: not when a network is gone."""
    return all(_there(observed, place) for place in container.attachments)


def _there(observed: HostState, place: Attachment) -> bool:
    """Whether the network is still the one that was joined, and not a new one of its name."""
    return any(
        network.name == place.network and place.network_id in ("", network.id)
        for network in observed.networks
    )


def _joined(observed: HostState, container: Container) -> list[str]:
    """The networks that a container is on, those aside that are gone."""
    return sorted(place.network for place in container.attachments if _there(observed, place))


def _running(context: PlanContext, found: Selection, kept: Container) -> SandboxSteps:
    if kept.state == "restarting":
        return SandboxSteps(tuple(removed(found.others, "left over")))
    actions: list[Action] = [*removed(found.others, "left over"), *_join(context, kept)]
    if not found.waiting:
        actions += named(kept, sandbox_name(context.key), _others(context))
    home = Home(_name_after(context, kept), kept.id, started_at=kept.started_at)
    return SandboxSteps(tuple(actions), home)


def _started(context: PlanContext, found: Selection, kept: Container) -> Iterator[Action]:
    yield from removed(found.others, "left over")
    for network in _joined(context.observed, kept):
        if network != context.settings.uplink:
            yield Disconnect(kept.name, network)
    if context.settings.uplink not in kept.networks:
        yield Connect(kept.name, context.settings.uplink, ())
    if found.old:
        yield from stopped(inhabitants(context, found.old.id), "its sandbox is made anew")
        yield from removed((found.old,), "another one takes over")
    yield Start(kept.name)
    yield from _connect(context, kept.name)
    yield from named(kept, sandbox_name(context.key), _others(context))


def _created(context: PlanContext, found: Selection, spec: SandboxSpec) -> Iterator[Action]:
    """Create a sandbox, in the place of an old one if there is one."""
    yield from removed(found.others, "left over")
    old = found.old
    former = former_name(old.name, spec.name, _others(context)) if old else ""
    if old and former != old.name:
        yield Rename(old.name, former)
    yield CreateSandbox(spec)
    if old:
        yield from stopped(inhabitants(context, old.id), "its sandbox is made anew")
        yield Remove(former, "made anew")
    yield Start(spec.name)
    yield from _connect(context, spec.name)


def _join(context: PlanContext, kept: Container) -> Iterator[Action]:
    """Resume a sandbox that is paused, and join the networks that it is not on."""
    if kept.state == "paused":
        yield Unpause(kept.name)
    if context.settings.uplink not in kept.networks:
        yield Connect(kept.name, context.settings.uplink, ())
    for network in sorted(context.desired.networks):
        if network in kept.networks and not _lacks_alias(context, kept, network):
            continue
        if network in kept.networks:
            yield Disconnect(kept.name, network)
        yield Connect(kept.name, network, _aliases(context, network))


def _lacks_alias(context: PlanContext, kept: Container, network: str) -> bool:
    """Whether to join a network anew for a name that is missing.

    That cuts the connections there, so it is done only where somebody looks for that name.
    """
    return any(
        needed_by(context.desired, network, alias)
        for alias in _aliases(context, network)
        if not holds(kept, network, alias)
    )


def _connect(context: PlanContext, name: str) -> Iterator[Action]:
    for network in sorted(context.desired.networks):
        yield Connect(name, network, _aliases(context, network))


def _aliases(context: PlanContext, network: str) -> tuple[str, ...]:
    return context.aliases.get((context.key, network), ())


def _others(context: PlanContext) -> frozenset[str]:
    return context.taken(tuple(one.container for one in context.sandboxes))


def _name_after(context: PlanContext, kept: Container) -> str:
    """What a sandbox is called when the steps are done."""
    name = sandbox_name(context.key)
    return kept.name if name in _others(context) else name
