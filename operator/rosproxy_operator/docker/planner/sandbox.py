"""What is to be done for a sandbox: the container that holds a proxy's ports and networks.

The order is such that a controller may be killed after any step: what it leaves is recognised and
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
    Case,
    former_name,
    inhabitants,
    named,
    removed,
    stopped,
)
from rosproxy_operator.docker.planner.model import Attachment, Container, Desired, Observed
from rosproxy_operator.docker.planner.selection import Succession, free_name, succession
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


def sandbox_steps(case: Case) -> SandboxSteps:
    """The next actions for the sandbox of a key that is wanted."""
    forwards = _forwards(case)
    print_ = sandbox_fingerprint(case.key, case.ports, case.settings, forwards)
    right = {
        one.container.id
        for one in case.sandboxes
        if one.range == case.ports and (not case.creatable or one.fingerprint == print_)
    }
    found = succession(
        (one.container for one in case.sandboxes),
        sandbox_name(case.key),
        right=lambda container: container.id in right,
        usable=lambda container: startable(case.observed, container),
        creatable=case.creatable,
    )
    kept = found.kept
    if kept and kept.state in SERVING:
        return _running(case, found, kept)
    if kept:
        home = Home(_name_after(case, kept), kept.id, starts=True)
        return SandboxSteps(tuple(_started(case, found, kept)), home)
    if found.waiting or found.stuck:
        return SandboxSteps(stuck=found.stuck)
    name = free_name(sandbox_name(case.key), _others(case))
    spec = SandboxSpec(name, case.key, case.ports, print_, case.settings.uplink, forwards)
    return SandboxSteps(tuple(_created(case, found, spec)), Home(name, starts=True))


def _forwards(case: Case) -> bool:
    """Whether the kernel is to forward in the sandbox.

    One where it did is not used without: a proxy that was killed has left its rules there, and one
    without the capability can't take them away.
    """
    return case.desired.data_plane == "kernel"


def leave(
    observed: Observed, desired: Desired, containers: tuple[Container, ...], uplink: str
) -> tuple[Disconnect, ...]:
    """Take sandboxes off the networks on which nobody wants them any more."""
    return tuple(
        Disconnect(container.name, network)
        for container in containers
        if container.state in _CHANGEABLE
        for network in _joined(observed, container)
        if network not in desired.networks | {uplink}
    )


def startable(observed: Observed, container: Container) -> bool:
    """Whether the engine can start a container that has stopped: not when a network is gone."""
    return all(_there(observed, place) for place in container.attachments)


def _there(observed: Observed, place: Attachment) -> bool:
    """Whether the network is still the one that was joined, and not a new one of its name."""
    return any(
        network.name == place.network and place.network_id in ("", network.id)
        for network in observed.networks
    )


def _joined(observed: Observed, container: Container) -> list[str]:
    """The networks that a container is on, those aside that are gone."""
    return sorted(place.network for place in container.attachments if _there(observed, place))


def _running(case: Case, found: Succession, kept: Container) -> SandboxSteps:
    if kept.state == "restarting":
        return SandboxSteps(tuple(removed(found.others, "left over")))
    actions: list[Action] = [*removed(found.others, "left over"), *_join(case, kept)]
    if not found.waiting:
        actions += named(kept, sandbox_name(case.key), _others(case))
    home = Home(_name_after(case, kept), kept.id, started_at=kept.started_at)
    return SandboxSteps(tuple(actions), home)


def _started(case: Case, found: Succession, kept: Container) -> Iterator[Action]:
    yield from removed(found.others, "left over")
    for network in _joined(case.observed, kept):
        if network != case.settings.uplink:
            yield Disconnect(kept.name, network)
    if case.settings.uplink not in kept.networks:
        yield Connect(kept.name, case.settings.uplink, ())
    if found.old:
        yield from stopped(inhabitants(case, found.old.id), "its sandbox is made anew")
        yield from removed((found.old,), "another one takes over")
    yield Start(kept.name)
    yield from _connect(case, kept.name)
    yield from named(kept, sandbox_name(case.key), _others(case))


def _created(case: Case, found: Succession, spec: SandboxSpec) -> Iterator[Action]:
    """Create a sandbox, in the place of an old one if there is one."""
    yield from removed(found.others, "left over")
    old = found.old
    former = former_name(old.name, spec.name, _others(case)) if old else ""
    if old and former != old.name:
        yield Rename(old.name, former)
    yield CreateSandbox(spec)
    if old:
        yield from stopped(inhabitants(case, old.id), "its sandbox is made anew")
        yield Remove(former, "made anew")
    yield Start(spec.name)
    yield from _connect(case, spec.name)


def _join(case: Case, kept: Container) -> Iterator[Action]:
    """Resume a sandbox that is paused, and join the networks that it is not on."""
    if kept.state == "paused":
        yield Unpause(kept.name)
    if case.settings.uplink not in kept.networks:
        yield Connect(kept.name, case.settings.uplink, ())
    for network in sorted(case.desired.networks):
        if network in kept.networks and not _lacks_alias(case, kept, network):
            continue
        if network in kept.networks:
            yield Disconnect(kept.name, network)
        yield Connect(kept.name, network, _aliases(case, network))


def _lacks_alias(case: Case, kept: Container, network: str) -> bool:
    """Whether to join a network anew for a name that is missing.

    That cuts the connections there, so it is done only where somebody looks for that name.
    """
    return any(
        needed_by(case.desired, network, alias)
        for alias in _aliases(case, network)
        if not holds(kept, network, alias)
    )


def _connect(case: Case, name: str) -> Iterator[Action]:
    for network in sorted(case.desired.networks):
        yield Connect(name, network, _aliases(case, network))


def _aliases(case: Case, network: str) -> tuple[str, ...]:
    return case.aliases.get((case.key, network), ())


def _others(case: Case) -> frozenset[str]:
    return case.taken(tuple(one.container for one in case.sandboxes))


def _name_after(case: Case, kept: Container) -> str:
    """What a sandbox is called when the steps are done."""
    name = sandbox_name(case.key)
    return kept.name if name in _others(case) else name
