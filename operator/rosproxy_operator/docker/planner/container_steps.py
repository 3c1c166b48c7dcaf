"""What is to be done for a proxy's two containers: its sandbox, and the one in which it runs.

The sandbox holds the proxy's ports and networks. The order is such that the operator may be killed
after any step: what it leaves is recognised and finished, and nothing that runs goes before what
takes over has been created.

Networks are joined after the start: an engine that starts a container with several networks joins
them in any order, and may lay the published ports over one and then move them to the uplink.
"""

from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass

from msgspec.structs import replace

from rosproxy.access.layers import PolicyLayer
from rosproxy.leases.ports import PortRange
from rosproxy.net.addresses import HostPort
from rosproxy_operator.docker.option_values import NOWHERE
from rosproxy_operator.docker.planner.actions import (
    Action,
    Connect,
    Create,
    CreateLanRelay,
    CreateSandbox,
    Disconnect,
    Remove,
    Rename,
    Restart,
    Start,
    Unpause,
)
from rosproxy_operator.docker.planner.aliases import Naming, answers_to, needed_by
from rosproxy_operator.docker.planner.duplicates import Selection, free_name, select
from rosproxy_operator.docker.planner.instants import instant
from rosproxy_operator.docker.planner.label_policy import label_layers
from rosproxy_operator.docker.planner.model import (
    SERVING,
    STARTED,
    ZENOH,
    Attachment,
    Container,
    Desired,
    HostState,
    Key,
    OwnContainer,
    Proxy,
    Sandbox,
)
from rosproxy_operator.docker.planner.specs import (
    proxy_fingerprint,
    proxy_name,
    sandbox_fingerprint,
    sandbox_name,
)
from rosproxy_operator.docker.settings import PlanSettings

REPLACED = "replaced by another container"
"""Why a container is removed whose successor has been created."""
_CHANGEABLE = frozenset({"created", "running", "paused", "exited"})


@dataclass(frozen=True, slots=True)
class PlanContext:
    """One key that is wanted, what there is for it, and what it gets: ports, and names.

    ``creatable``: the image and the uplink are there or can be made.
    """

    observed: HostState
    settings: PlanSettings
    desired: Desired
    ports: PortRange
    naming: Naming
    creatable: bool

    def aliases(self, network: str) -> tuple[str, ...]:
        """The proxy's names on a network."""
        return self.naming.aliases.get(self.desired.key, {}).get(network, ())

    def taken(self, own: Iterable[OwnContainer]) -> frozenset[str]:
        """The names of all containers but these."""
        containers = [*self.observed.containers, *(o.container for o in self.observed.own)]
        return frozenset(c.name for c in containers) - {o.container.name for o in own}

    @property
    def label_policy(self) -> tuple[PolicyLayer, ...]:
        """The layers of its containers' labels."""
        by_id = {container.id: container for container in self.observed.containers}
        return label_layers(self.desired.members, by_id, self.desired.networks)

    @property
    def lan_relay(self) -> HostPort | None:
        """Where the proxy's LAN relay listens; None if it is to have none."""
        if not self.desired.key.is_ros2 or self.settings.ros2_lan == NOWHERE:
            return None
        gateway = self.observed.gateway(self.settings.uplink)
        return HostPort(gateway, self.ports.last) if gateway else None

    def select(
        self,
        own: Collection[OwnContainer],
        name: str,
        fingerprint: str,
        fits: Callable[[Container], bool],
    ) -> Selection:
        """Decide which of these stays and which goes.

        Right is one that ``fits``, has the ports, and the ``fingerprint`` of one that would be made
        now; if none can be, any fingerprint will do.
        """
        matching = [o for o in own if o.fingerprint == fingerprint or not self.creatable]
        candidates = [o.container for o in matching if o.range == self.ports]
        return select(own, name, {c.id for c in candidates if fits(c)}, self.creatable)


@dataclass(frozen=True, slots=True)
class _SandboxChoice:
    """The sandbox in which a proxy is to run.

    ``id`` is empty if it is yet to be created. ``starts``: the steps start it, so that a proxy
    which was in it must be started anew; else ``started_at`` is when it was.
    """

    name: str
    id: str = ""
    starts: bool = False
    started_at: str = ""


def wanted_steps(context: PlanContext) -> list[Action] | None:
    """The next actions for a key that is wanted, but for networks that its sandboxes leave.

    None if a container ought to be created but can't.
    """
    actions, home = _sandbox_steps(context)
    if actions is None or home is None:
        return actions
    process_actions = _process_steps(context, home, _removed(actions))
    return None if process_actions is None else actions + process_actions


def removal_steps(
    observed: HostState, key: Key, reason: str, again: bool = False
) -> Iterator[Action]:
    """Remove everything of a key; ``again`` also what the engine is removing already."""
    # A proxy that retires reaches the LAN by its relay, and all of outside by its sandbox.
    ordered = (*observed.proxies_of(key), *observed.lan_relays_of(key), *observed.sandboxes_of(key))
    for own in ordered:
        if own.container.state == "paused" and not isinstance(own, Sandbox):
            yield Unpause(own.container.name)
    for own in ordered:
        state = own.container.state
        if again or state != "removing":
            retire = isinstance(own, Proxy) and state in STARTED and key != ZENOH
            yield Remove(own.container.name, reason, retire=retire)


def disconnect_steps(
    observed: HostState,
    desired: Desired,
    planned: Collection[Action] | None,
    uplink: str,
    naming: Naming,
) -> Iterator[Disconnect]:
    """Take sandboxes that stay off the networks on which no container wants them any more.

    ``planned`` are the key's other actions, which may say so themselves. Without any, a sandbox
    also leaves where it has a name that it must not have: no other step makes it join anew.
    """
    is_idle = not desired.live or planned is None
    planned = planned or ()
    gone = _removed(planned)
    for sandbox in observed.sandboxes_of(desired.key):
        container = sandbox.container
        if container.state in _CHANGEABLE and container.name not in gone:
            for network in _joined(observed, container):
                action = Disconnect(container.name, network)
                unwanted = network not in desired.networks | {uplink}
                misnamed = is_idle and naming.is_misnamed(container, network)
                if (unwanted or misnamed) and action not in planned:
                    yield action


def _removed(actions: Iterable[Action]) -> set[str]:
    return {action.name for action in actions if isinstance(action, Remove)}


def _sandbox_steps(context: PlanContext) -> tuple[list[Action] | None, _SandboxChoice | None]:
    """The actions for the sandbox, and which one it is then; None if none is going to run.

    No actions but None if one ought to be created but can't.
    """
    key = context.desired.key
    sandboxes = context.observed.sandboxes_of(key)
    taken = context.taken(sandboxes)
    # A sandbox where the kernel forwarded is not used without: a proxy that was killed has left its
    # rules there, and one without the capability can't take them away.
    action = CreateSandbox(sandbox_name(key), key, context.ports, context.desired.spec)
    expected = sandbox_fingerprint(action, context.settings)
    selection = context.select(
        sandboxes, action.name, expected, lambda c: _usable(c, context.observed)
    )
    kept = selection.kept
    if selection.stuck:
        return None, None
    actions: list[Action] = [Remove(c.name, "left over") for c in selection.surplus]
    if kept is None and not selection.waiting:
        action = replace(action, name=free_name(action.name, taken), fingerprint=expected)
        former = former_name(selection.predecessor, action.name, taken)
        ended = _emptying_steps(context, selection.predecessor) if selection.predecessor else ()
        actions += [
            *creation_steps(selection, action, former, ended),
            *_connect(context, action.name),
        ]
        return actions, _SandboxChoice(action.name, starts=True)
    # One that is restarting has no network namespace until it is up again: nothing can be joined,
    # and no proxy started in it (moby: daemon/container_operations.go, getNetworkedContainer).
    if kept is None or kept.state == "restarting":
        return actions, None
    name = kept.name if selection.waiting or action.name in taken else action.name
    serves = kept.state in SERVING
    actions += _join_steps(context, kept) if serves else _start_steps(context, selection, kept)
    if kept.name != name:
        actions.append(Rename(kept.name, name))
    return actions, _SandboxChoice(name, kept.id, not serves, kept.started_at)


def _usable(sandbox: Container, observed: HostState) -> bool:
    """Whether it runs or the engine can start it: not when one of its networks is gone."""
    return sandbox.state in SERVING or all(_has_network(observed, a) for a in sandbox.attachments)


def _has_network(observed: HostState, attachment: Attachment) -> bool:
    """Whether the network is still the one that was joined, and not a new one of its name."""
    return any(
        network.name == attachment.network and attachment.network_id in ("", network.id)
        for network in observed.networks
    )


def _joined(observed: HostState, container: Container) -> list[str]:
    """The networks that a container is on, without those that are gone."""
    return sorted(a.network for a in container.attachments if _has_network(observed, a))


def _join_steps(context: PlanContext, kept: Container) -> Iterator[Action]:
    """Resume a sandbox that is paused, and join the networks that it is not on."""
    if kept.state == "paused":
        yield Unpause(kept.name)
    if context.settings.uplink not in kept.networks:
        yield Connect(kept.name, context.settings.uplink, ())
    for network in sorted(context.desired.networks):
        misnamed = context.naming.is_misnamed(kept, network) or _lacks_alias(context, kept, network)
        if network in kept.networks and not misnamed:
            continue
        if network in kept.networks:
            yield Disconnect(kept.name, network)
        yield Connect(kept.name, network, context.aliases(network))


def _lacks_alias(context: PlanContext, kept: Container, network: str) -> bool:
    """Whether to join a network anew for a name that is missing.

    That cuts the connections there, so it is done only where somebody looks for that name.
    """
    return any(
        needed_by(context.desired, network, alias)
        for alias in context.aliases(network)
        if not answers_to(kept, network, alias)
    )


def _start_steps(context: PlanContext, selection: Selection, kept: Container) -> Iterator[Action]:
    for network in _joined(context.observed, kept):
        if network != context.settings.uplink:
            yield Disconnect(kept.name, network)
    if context.settings.uplink not in kept.networks:
        yield Connect(kept.name, context.settings.uplink, ())
    if selection.predecessor:
        yield from _emptying_steps(context, selection.predecessor)
        yield Remove(selection.predecessor.name, REPLACED)
    yield Start(kept.name)
    yield from _connect(context, kept.name)


def _connect(context: PlanContext, name: str) -> Iterator[Action]:
    for network in sorted(context.desired.networks):
        yield Connect(name, network, context.aliases(network))


def _emptying_steps(context: PlanContext, old: Container) -> Iterator[Action]:
    """End the proxies properly that are in a sandbox, before it goes."""
    for proxy in context.observed.proxies_of(context.desired.key):
        if proxy.container.network_container == old.id and proxy.container.state != "removing":
            yield Remove(proxy.container.name, "the sandbox is replaced", stop=True)


def _process_steps(
    context: PlanContext, home: _SandboxChoice, gone: Collection[str]
) -> list[Action] | None:
    """The actions for the container in which the proxy runs; None if one can't be created.

    ``gone`` are the names of containers that are removed before.
    """
    key = context.desired.key
    wanted_name = proxy_name(context.desired.key)
    proxies = context.observed.proxies_of(key)
    taken = context.taken(proxies)
    name = free_name(wanted_name, taken)
    action = Create(
        name,
        key,
        context.ports,
        home.name,
        context.desired.spec,
        policy=context.label_policy,
        peers=context.desired.peers,
        lan_relay=context.lan_relay,
    )
    observed = context.observed
    expected = proxy_fingerprint(action, context.settings, observed.image_id, observed.secret)
    staying = [p for p in proxies if p.container.name not in gone]
    selection = context.select(
        staying, wanted_name, expected, lambda c: c.network_container == home.id
    )
    kept = selection.kept
    misplaced = kept and kept.network_container != home.id
    if selection.waiting and (misplaced or not kept):
        return []
    if selection.stuck or misplaced:
        return None
    actions: list[Action] = [Remove(c.name, "left over") for c in selection.surplus]
    if kept:
        actions += keep_running_steps(selection, kept, _lost(kept, home))
        if wanted_name not in (kept.name, *taken) and not selection.waiting:
            actions.append(Rename(kept.name, wanted_name))
        return actions
    former = former_name(selection.predecessor, name, taken)
    removed = [p.container.name for p in proxies if p.container.name in gone]
    replaces = former or next(iter(removed), "")
    action = replace(action, fingerprint=expected, replaces=replaces)
    return [*actions, *creation_steps(selection, action, former)]


def keep_running_steps(
    selection: Selection, kept: Container, lost: bool = False
) -> Iterator[Action]:
    """Have a container run that stays; one that is ``lost`` is to be started anew."""
    if selection.predecessor:
        yield Remove(selection.predecessor.name, REPLACED)
    if kept.state == "paused":
        yield Unpause(kept.name)
    if selection.waiting:
        return
    if kept.state not in SERVING:
        yield Start(kept.name)
    elif lost:
        yield Restart(kept.name)


def _lost(kept: Container, home: _SandboxChoice) -> bool:
    """Whether a proxy runs in the namespace that its sandbox had before it was started anew."""
    if home.starts:
        return True
    # One that is restarting enters the sandbox's present namespace by itself.
    if not kept.started_at or not home.started_at or kept.state == "restarting":
        return False
    return instant(kept.started_at) < instant(home.started_at)


def former_name(old: Container | None, name: str, taken: Collection[str]) -> str:
    """What to call the old one, if any, so that the one that takes over can have the name."""
    if old is None:
        return ""
    return free_name(f"{name}-old", taken) if old.name == name else old.name


def creation_steps(
    selection: Selection,
    action: CreateSandbox | Create | CreateLanRelay,
    former: str,
    ended: Iterable[Action] = (),
) -> Iterator[Action]:
    """Create and start a container, in the place of an old one, now to be ``former``, if any.

    ``ended``: what must go before the old one does.
    """
    if selection.predecessor and selection.predecessor.name != former:
        yield Rename(selection.predecessor.name, former)
    yield action
    if selection.predecessor:
        yield from ended
        yield Remove(former, REPLACED)
    yield Start(action.name)
