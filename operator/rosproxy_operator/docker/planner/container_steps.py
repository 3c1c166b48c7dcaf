"""Plan the actions for the two containers of a proxy: the sandbox and the proxy's own container.

The sandbox holds the ports and networks of the proxy. The operator may be killed after any action:
the next look recognises the state, and the next plan finishes the work. A container that serves is
removed only after the successor has been created.

A sandbox joins networks after the start. If a container starts with several networks, the engine
joins these in any order. So the engine may publish the ports over one network, and move the ports
to the uplink later.
"""

from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass

from msgspec.structs import replace

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.policy.layers import PolicyLayer
from rosproxy.shared.ports import PortRange
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
from rosproxy_operator.docker.planner.aliases import Naming, answers_to, containers_seeking
from rosproxy_operator.docker.planner.duplicates import Selection, free_name, select
from rosproxy_operator.docker.planner.instants import instant
from rosproxy_operator.docker.planner.label_policy import label_layers
from rosproxy_operator.docker.planner.model import (
    SERVING,
    STARTED,
    Attachment,
    Container,
    Desired,
    HostState,
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
from rosproxy_operator.proxy_spec.place import ZENOH, Domain, Place

REPLACED = "replaced by another container"
"""The reason in `Remove` for a container that has a successor."""
RETIRED = "the proxy has unregistered its nodes, and accepts no others"
"""The reason in `Remove` for a proxy that was to go, but is needed again."""
_CONNECTABLE_STATES = frozenset({"created", "running", "paused", "exited"})
"""States in which the operator disconnects a sandbox from a network."""


@dataclass(frozen=True, slots=True)
class PlanContext:
    """A wanted proxy, the state of the host, and the ports and names for the proxy.

    ``creatable``: the image exists, and the uplink is usable or can be created.
    """

    observed: HostState
    settings: PlanSettings
    desired: Desired
    ports: PortRange
    naming: Naming
    creatable: bool

    def aliases(self, network: str) -> tuple[str, ...]:
        """Return the names of the proxy on a network."""
        return self.naming.aliases.get(self.desired.place, {}).get(network, ())

    def taken(self, own: Iterable[OwnContainer]) -> frozenset[str]:
        """Return the names of all containers except ``own``."""
        containers = [*self.observed.containers, *(o.container for o in self.observed.own)]
        return frozenset(c.name for c in containers) - {o.container.name for o in own}

    @property
    def label_policy(self) -> tuple[PolicyLayer, ...]:
        """The layers from the labels of the proxy's containers."""
        routers = self.ports if self.desired.place == ZENOH else None
        return label_layers(self.desired.members, self.observed, self.desired.networks, routers)

    @property
    def lan_relay(self) -> HostPort | None:
        """The endpoint of the LAN relay; None if the proxy gets no LAN relay."""
        if not isinstance(self.desired.place.graph, Domain) or self.settings.ros2_lan == NOWHERE:
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
        """Decide which of the containers ``own`` stays and which goes.

        A container that fits has the planned ports and the ``fingerprint``, has not retired, and
        ``fits`` returns true for it. If no container can be created, any fingerprint counts.
        ``name`` is the name for the container that stays.
        """
        matching = [o for o in own if o.fingerprint == fingerprint or not self.creatable]
        candidates = [o.container for o in matching if o.range == self.ports]
        candidates = [c for c in candidates if c.name not in self.observed.retired]
        return select(own, name, {c.id for c in candidates if fits(c)}, self.creatable)


@dataclass(frozen=True, slots=True)
class _SandboxChoice:
    """The sandbox for a proxy.

    ``id`` is empty if the plan creates the sandbox. ``starts``: the plan starts the sandbox, so a
    proxy in the sandbox has to restart. ``started_at`` is the time of the last start, as the engine
    writes times.
    """

    name: str
    id: str = ""
    starts: bool = False
    started_at: str = ""


def wanted_steps(context: PlanContext) -> list[Action] | None:
    """Return the next actions for a wanted proxy, without the actions of `disconnect_steps`.

    None if a container is missing and can't be created.
    """
    actions, sandbox = _sandbox_steps(context)
    if actions is None or sandbox is None:
        return actions
    proxy_actions = _proxy_steps(context, sandbox, _removed(actions))
    return None if proxy_actions is None else actions + proxy_actions


def removal_steps(
    observed: HostState, place: Place, reason: str, again: bool = False
) -> Iterator[Action]:
    """Yield the actions that remove all containers of a proxy.

    With ``again``, the actions include containers that the engine is removing already.
    """
    # A proxy that retires needs the LAN relay to reach the LAN, and the sandbox to reach outside.
    ordered = (
        *observed.proxies_of(place),
        *observed.lan_relays_of(place),
        *observed.sandboxes_of(place),
    )
    for own in ordered:
        if own.container.state == "paused" and not isinstance(own, Sandbox):
            yield Unpause(own.container.name)
    for own in ordered:
        state = own.container.state
        if again or state != "removing":
            retire = isinstance(own, Proxy) and state in STARTED and place != ZENOH
            yield Remove(own.container.name, reason, retire=retire)


def disconnect_steps(
    observed: HostState,
    desired: Desired,
    planned: Collection[Action] | None,
    uplink: str,
    naming: Naming,
) -> Iterator[Disconnect]:
    """Yield the actions by which sandboxes leave the networks that need no proxy any more.

    ``planned`` has the other actions of the proxy, which may include a Disconnect already. If the
    proxy is not live or ``planned`` is None, a sandbox also leaves networks where it has a
    withdrawn name: no other action removes that name.
    """
    is_idle = not desired.live or planned is None
    planned = planned or ()
    gone = _removed(planned)
    for sandbox in observed.sandboxes_of(desired.place):
        container = sandbox.container
        if container.state in _CONNECTABLE_STATES and container.name not in gone:
            for network in _existing_networks(observed, container):
                action = Disconnect(container.name, network)
                unwanted = network not in desired.networks | {uplink}
                misnamed = is_idle and naming.is_misnamed(container, network)
                if (unwanted or misnamed) and action not in planned:
                    yield action


def _removed(actions: Iterable[Action]) -> set[str]:
    return {action.name for action in actions if isinstance(action, Remove)}


def _sandbox_steps(context: PlanContext) -> tuple[list[Action] | None, _SandboxChoice | None]:
    """Return the actions for the sandbox, and the sandbox.

    The sandbox is None if no sandbox is going to run. The actions are None if the sandbox is
    missing and can't be created.
    """
    place = context.desired.place
    sandboxes = context.observed.sandboxes_of(place)
    taken = context.taken(sandboxes)
    # The fingerprint depends on the data plane, so a proxy that loses the kernel plane gets another
    # sandbox. In the former sandbox, a killed proxy may have left rules. A proxy without NET_ADMIN
    # can't remove these rules.
    action = CreateSandbox(sandbox_name(place), place, context.ports, context.desired.spec)
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
        emptying = _emptying_steps(context, selection.predecessor) if selection.predecessor else ()
        actions += [
            *creation_steps(selection, action, former, emptying),
            *_connect(context, action.name),
        ]
        return actions, _SandboxChoice(action.name, starts=True)
    # A sandbox that restarts has no network namespace, so the engine refuses to connect the sandbox
    # and to start a proxy there (moby: daemon/container_operations.go, getNetworkedContainer).
    if kept is None or kept.state == "restarting":
        return actions, None
    name = kept.name if selection.waiting or action.name in taken else action.name
    serves = kept.state in SERVING
    actions += _join_steps(context, kept) if serves else _start_steps(context, selection, kept)
    if kept.name != name:
        actions.append(Rename(kept.name, name))
    return actions, _SandboxChoice(name, kept.id, not serves, kept.started_at)


def _usable(sandbox: Container, observed: HostState) -> bool:
    """Return whether a sandbox runs, or can start because all of its networks exist."""
    return sandbox.state in SERVING or all(_has_network(observed, a) for a in sandbox.attachments)


def _has_network(observed: HostState, attachment: Attachment) -> bool:
    """Return whether the network of an attachment exists, and not only another of that name."""
    return any(
        network.name == attachment.network and attachment.network_id in ("", network.id)
        for network in observed.networks
    )


def _existing_networks(observed: HostState, container: Container) -> list[str]:
    """Return the names of a container's networks that still exist."""
    return sorted(a.network for a in container.attachments if _has_network(observed, a))


def _join_steps(context: PlanContext, kept: Container) -> Iterator[Action]:
    """Resume a paused sandbox, and join the missing networks."""
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
    """Return whether a sandbox has to join a network again to get a missing name.

    Only a name that a container looks for counts, since joining again cuts all connections there.
    """
    return any(
        containers_seeking(context.desired, network, alias)
        for alias in context.aliases(network)
        if not answers_to(kept, network, alias)
    )


def _start_steps(context: PlanContext, selection: Selection, kept: Container) -> Iterator[Action]:
    for network in _existing_networks(context.observed, kept):
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
    """Yield the actions that stop and remove the proxies in a sandbox, before the sandbox goes."""
    for proxy in context.observed.proxies_of(context.desired.place):
        if proxy.container.network_container == old.id and proxy.container.state != "removing":
            yield Remove(proxy.container.name, "the sandbox is replaced", stop=True)


def _proxy_steps(
    context: PlanContext, sandbox: _SandboxChoice, gone: Collection[str]
) -> list[Action] | None:
    """Return the actions for the proxy's own container; None if no such container can be created.

    ``gone`` has the names of the containers that earlier actions remove.
    """
    place = context.desired.place
    wanted_name = proxy_name(context.desired.place)
    proxies = context.observed.proxies_of(place)
    taken = context.taken(proxies)
    name = free_name(wanted_name, taken)
    action = Create(
        name,
        place,
        context.ports,
        sandbox.name,
        context.desired.spec,
        policy=context.label_policy,
        peers=context.desired.peers,
        lan_relay=context.lan_relay,
        links=context.desired.links,
    )
    observed = context.observed
    expected = proxy_fingerprint(action, context.settings, observed.image_id, observed.secret)
    staying = [p for p in proxies if p.container.name not in gone]
    selection = context.select(
        staying, wanted_name, expected, lambda c: c.network_container == sandbox.id
    )
    kept = selection.kept
    misplaced = kept and kept.network_container != sandbox.id
    if selection.waiting and (misplaced or not kept):
        return []
    if selection.stuck or misplaced:
        return None
    actions: list[Action] = [Remove(c.name, "left over") for c in selection.surplus]
    if kept:
        actions += keep_running_steps(selection, kept, _lost(kept, sandbox))
        if wanted_name not in (kept.name, *taken) and not selection.waiting:
            actions.append(Rename(kept.name, wanted_name))
        return actions
    former = former_name(selection.predecessor, name, taken)
    removed = [p.container.name for p in proxies if p.container.name in gone]
    replaces = former or next(iter(removed), "")
    action = replace(action, fingerprint=expected, replaces=replaces)
    old = selection.predecessor
    reason = RETIRED if old and old.name in observed.retired else REPLACED
    return [*actions, *creation_steps(selection, action, former, reason=reason)]


def keep_running_steps(
    selection: Selection, kept: Container, lost: bool = False
) -> Iterator[Action]:
    """Yield the actions that keep a container running.

    A ``lost`` container runs in a former network namespace (`_lost`), and restarts.
    """
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


def _lost(kept: Container, sandbox: _SandboxChoice) -> bool:
    """Return whether a proxy runs in a former network namespace: the sandbox started later."""
    if sandbox.starts:
        return True
    # A proxy that restarts enters the present namespace of the sandbox.
    if not kept.started_at or not sandbox.started_at or kept.state == "restarting":
        return False
    return instant(kept.started_at) < instant(sandbox.started_at)


def former_name(old: Container | None, name: str, taken: Collection[str]) -> str:
    """Return the name for the old container, so that ``name`` is free; empty if ``old`` is None."""
    if old is None:
        return ""
    return free_name(f"{name}-old", taken) if old.name == name else old.name


def creation_steps(
    selection: Selection,
    action: CreateSandbox | Create | CreateLanRelay,
    former: str,
    before_removal: Iterable[Action] = (),
    reason: str = REPLACED,
) -> Iterator[Action]:
    """Yield the actions that create and start a container, in place of the predecessor, if any.

    The predecessor is renamed to ``former``, and removed after the actions ``before_removal``, for
    the ``reason``.
    """
    if selection.predecessor and selection.predecessor.name != former:
        yield Rename(selection.predecessor.name, former)
    yield action
    if selection.predecessor:
        yield from before_removal
        yield Remove(former, reason)
    yield Start(action.name)
