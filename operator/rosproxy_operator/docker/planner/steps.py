"""What is to be done for a proxy's two containers: its sandbox, and the one in which it runs.

The sandbox holds the proxy's ports and networks. The order is such that the operator may be killed
after any step: what it leaves is recognised and finished, and nothing that runs goes before what
takes over has been created.

Networks are joined after the start: an engine that starts a container with several networks joins
them in any order, and may lay the published ports over one and then move them to the uplink.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass

from msgspec.structs import replace

from rosproxy.access.layers import PolicyLayer
from rosproxy.leases.ports import PortRange
from rosproxy.net.addresses import HostPort
from rosproxy_operator.docker.planner.actions import (
    Action,
    Connect,
    Create,
    CreateEar,
    CreateSandbox,
    Disconnect,
    Remove,
    Rename,
    Restart,
    Start,
    Unpause,
)
from rosproxy_operator.docker.planner.desired import holds, needed_by
from rosproxy_operator.docker.planner.label_policy import label_layers
from rosproxy_operator.docker.planner.model import (
    NOWHERE,
    SERVING,
    STARTED,
    Attachment,
    Container,
    Desired,
    HostState,
    Key,
    OwnContainer,
    PlanSettings,
    Proxy,
)
from rosproxy_operator.docker.planner.selection import Selection, free_name, select
from rosproxy_operator.docker.planner.specs import (
    proxy_fingerprint,
    proxy_name,
    sandbox_fingerprint,
    sandbox_name,
)

_CHANGEABLE = frozenset({"created", "running", "paused", "exited"})


@dataclass(frozen=True, slots=True)
class PlanContext:
    """One key that is wanted, what there is for it, and what it gets: ports, and names by network.

    ``creatable``: the image and the uplink are there or can be made.
    """

    observed: HostState
    settings: PlanSettings
    desired: Desired
    ports: PortRange
    aliases: Mapping[str, tuple[str, ...]]
    creatable: bool

    def taken(self, own: Iterable[OwnContainer]) -> frozenset[str]:
        """The names of all containers but these."""
        every = [*self.observed.containers, *(one.container for one in self.observed.own)]
        return frozenset(one.name for one in every) - {one.container.name for one in own}

    @property
    def label_policy(self) -> tuple[PolicyLayer, ...]:
        """The layers of its containers' labels."""
        by_id = {container.id: container for container in self.observed.containers}
        return label_layers(self.desired.members, by_id, self.desired.networks)

    @property
    def ear(self) -> HostPort | None:
        """Where the proxy's ear listens; None if it is to have none."""
        if not self.desired.key.is_ros2 or self.settings.ros2_lan == NOWHERE:
            return None
        gateway = self.observed.gateway(self.settings.uplink)
        return HostPort(gateway, self.ports.last) if gateway else None

    def select(
        self, own: Collection[OwnContainer], name: str, made: str, fits: Callable[[Container], bool]
    ) -> Selection:
        """Decide which of these stays and which goes.

        Right is one that ``fits``, has the ports, and the fingerprint ``made`` of one that would be
        created now; if none can be, any will do.
        """
        as_made = [one for one in own if one.fingerprint == made or not self.creatable]
        here = [one.container for one in as_made if one.range == self.ports]
        return select(own, name, {one.id for one in here if fits(one)}, self.creatable)


@dataclass(frozen=True, slots=True)
class _Home:
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
    then = _process_steps(context, home, _removed(actions))
    return None if then is None else actions + then


def retired(observed: HostState, key: Key) -> Iterator[Action]:
    """Remove everything of a key that nobody wants any more."""
    why = "no running container wants it any more"
    for one in (*observed.ears_of(key), *observed.proxies_of(key), *observed.sandboxes_of(key)):
        state, name = one.container.state, one.container.name
        if state == "paused" and isinstance(one, Proxy):
            yield Unpause(name)
        if state != "removing":
            yield Remove(name, why, retire=isinstance(one, Proxy) and state in STARTED)


def leave(
    observed: HostState, desired: Desired, planned: Collection[Action], uplink: str
) -> Iterator[Disconnect]:
    """Take sandboxes that stay off the networks on which nobody wants them any more.

    ``planned`` are the key's other actions, which may say so themselves.
    """
    gone = _removed(planned)
    for sandbox in observed.sandboxes_of(desired.key):
        box = sandbox.container
        if box.state in _CHANGEABLE and box.name not in gone:
            for network in _joined(observed, box):
                action = Disconnect(box.name, network)
                if network not in desired.networks | {uplink} and action not in planned:
                    yield action


def _removed(actions: Iterable[Action]) -> set[str]:
    return {action.name for action in actions if isinstance(action, Remove)}


def _sandbox_steps(context: PlanContext) -> tuple[list[Action] | None, _Home | None]:
    """The actions for the sandbox, and which one it is then; None if none is going to run.

    No actions but None if one ought to be created but can't.
    """
    key = context.desired.key
    sandboxes = context.observed.sandboxes_of(key)
    taken = context.taken(sandboxes)
    # A sandbox where the kernel forwarded is not used without: a proxy that was killed has left its
    # rules there, and one without the capability can't take them away.
    forwards = context.desired.data_plane == "kernel"
    udp = context.desired.udp
    made = CreateSandbox(sandbox_name(key), key, context.ports, forwards=forwards, udp=udp)
    expected = sandbox_fingerprint(made, context.settings)
    found = context.select(
        sandboxes, made.name, expected, lambda box: _usable(box, context.observed)
    )
    kept = found.kept
    if found.stuck:
        return None, None
    actions: list[Action] = [Remove(one.name, "left over") for one in found.others]
    if kept is None and not found.waiting:
        made = replace(made, name=free_name(made.name, taken), fingerprint=expected)
        former = former_name(found.old, made.name, taken)
        ended = _emptied(context, found.old) if found.old else ()
        actions += [*created(found, made, former, ended), *_connect(context, made.name)]
        return actions, _Home(made.name, starts=True)
    if kept is None or kept.state == "restarting":
        return actions, None
    name = kept.name if found.waiting or made.name in taken else made.name
    serves = kept.state in SERVING
    actions += _joining(context, kept) if serves else _started(context, found, kept)
    if kept.name != name:
        actions.append(Rename(kept.name, name))
    return actions, _Home(name, kept.id, not serves, kept.started_at)


def _usable(sandbox: Container, observed: HostState) -> bool:
    """Whether it runs or the engine can start it: not when one of its networks is gone."""
    return sandbox.state in SERVING or all(_there(observed, each) for each in sandbox.attachments)


def _there(observed: HostState, place: Attachment) -> bool:
    """Whether the network is still the one that was joined, and not a new one of its name."""
    return any(
        network.name == place.network and place.network_id in ("", network.id)
        for network in observed.networks
    )


def _joined(observed: HostState, container: Container) -> list[str]:
    """The networks that a container is on, those aside that are gone."""
    return sorted(place.network for place in container.attachments if _there(observed, place))


def _joining(context: PlanContext, kept: Container) -> Iterator[Action]:
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
        yield Connect(kept.name, network, context.aliases.get(network, ()))


def _lacks_alias(context: PlanContext, kept: Container, network: str) -> bool:
    """Whether to join a network anew for a name that is missing.

    That cuts the connections there, so it is done only where somebody looks for that name.
    """
    return any(
        needed_by(context.desired, network, alias)
        for alias in context.aliases.get(network, ())
        if not holds(kept, network, alias)
    )


def _started(context: PlanContext, found: Selection, kept: Container) -> Iterator[Action]:
    for network in _joined(context.observed, kept):
        if network != context.settings.uplink:
            yield Disconnect(kept.name, network)
    if context.settings.uplink not in kept.networks:
        yield Connect(kept.name, context.settings.uplink, ())
    if found.old:
        yield from _emptied(context, found.old)
        yield Remove(found.old.name, "another one takes over")
    yield Start(kept.name)
    yield from _connect(context, kept.name)


def _connect(context: PlanContext, name: str) -> Iterator[Action]:
    for network in sorted(context.desired.networks):
        yield Connect(name, network, context.aliases.get(network, ()))


def _emptied(context: PlanContext, old: Container) -> Iterator[Action]:
    """End the proxies properly that are in a sandbox, before it goes."""
    for one in context.observed.proxies_of(context.desired.key):
        if one.container.shares == old.id and one.container.state != "removing":
            yield Remove(one.container.name, "its sandbox is made anew", stop=True)


def _process_steps(context: PlanContext, home: _Home, gone: Collection[str]) -> list[Action] | None:
    """The actions for the container in which the proxy runs; None if one can't be created.

    ``gone`` are the names of containers that are removed before.
    """
    key, wanted = context.desired.key, proxy_name(context.desired.key)
    proxies = context.observed.proxies_of(key)
    taken = context.taken(proxies)
    name = free_name(wanted, taken)
    made = Create(
        name,
        key,
        context.ports,
        home.name,
        context.desired.data_plane,
        slave_control=context.desired.slave_control,
        direction=context.desired.direction,
        udp=context.desired.udp,
        policy=context.label_policy,
        peers=context.desired.peers,
        ear=context.ear,
    )
    observed = context.observed
    expected = proxy_fingerprint(made, context.settings, observed.image_id, observed.secret)
    there = [one for one in proxies if one.container.name not in gone]
    found = context.select(there, wanted, expected, lambda one: one.shares == home.id)
    kept = found.kept
    misplaced = kept and kept.shares != home.id
    if found.waiting and (misplaced or not kept):
        return []
    if found.stuck or misplaced:
        return None
    actions: list[Action] = [Remove(one.name, "left over") for one in found.others]
    if kept:
        actions += tended(found, kept, _lost(kept, home))
        if wanted not in (kept.name, *taken) and not found.waiting:
            actions.append(Rename(kept.name, wanted))
        return actions
    former = former_name(found.old, name, taken)
    before = [one.container.name for one in proxies if one.container.name in gone]
    replaces = former or next(iter(before), "")
    made = replace(made, fingerprint=expected, replaces=replaces)
    return [*actions, *created(found, made, former)]


def tended(found: Selection, kept: Container, lost: bool = False) -> Iterator[Action]:
    """Have a container run that stays; one that is ``lost`` is to be started anew."""
    if found.old:
        yield Remove(found.old.name, "another one takes over")
    if kept.state == "paused":
        yield Unpause(kept.name)
    if found.waiting:
        return
    if kept.state not in SERVING:
        yield Start(kept.name)
    elif lost:
        yield Restart(kept.name)


def _lost(kept: Container, home: _Home) -> bool:
    """Whether a proxy runs in the namespace that its sandbox had before it was started anew."""
    if home.starts:
        return True
    if not kept.started_at or not home.started_at or kept.state == "restarting":
        return False
    return _instant(kept.started_at) < _instant(home.started_at)


def _instant(text: str) -> tuple[str, str]:
    """A time in the engine's words, so that it can be compared: their fractions vary in length."""
    seconds, _, fraction = text.removesuffix("Z").partition(".")
    return seconds, fraction.ljust(9, "0")


def former_name(old: Container | None, name: str, taken: Collection[str]) -> str:
    """What to call the old one, if any, so that the one that takes over can have the name."""
    if old is None:
        return ""
    return free_name(f"{name}-old", taken) if old.name == name else old.name


def created(
    found: Selection,
    made: CreateSandbox | Create | CreateEar,
    former: str,
    ended: Iterable[Action] = (),
) -> Iterator[Action]:
    """Create and start a container, in the place of an old one, now to be ``former``, if any.

    ``ended``: what must go before the old one does.
    """
    if found.old and found.old.name != former:
        yield Rename(found.old.name, former)
    yield made
    if found.old:
        yield from ended
        yield Remove(former, "made anew")
    yield Start(made.name)
