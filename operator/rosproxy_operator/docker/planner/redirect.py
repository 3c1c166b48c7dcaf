"""A master that is given by address: its address leads to the proxy, in the container's network.

No name can stand in for an address. So a rule of nftables in the network namespace of the labelled
container sends what its nodes open to that one address and port to the proxy instead, as service
meshes do. It is set by a container of the proxy's image that joins this namespace, has NET_ADMIN
there, runs ``nft`` once and ends: it parses nothing, and nobody can talk to it.

What has ended is kept as the record of the rules, since the operator has no disk: its labels say in
which start of the container they were made, and what they are made of. Every start has a namespace
of its own, without rules. Where a record says something else than is wanted, the rules are set
anew, in one transaction; where nothing is wanted any more, they are taken away and the record goes
last. Connections that were there before stay as they are.

A redirect is only set towards a proxy that runs. Once it is there, it stays while the proxy is away
for a moment: its nodes then meet nobody, as they would by a name.
"""

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from string import Template
from typing import Any

from msgspec.structs import replace

from rosproxy.leases.ports import PortRange
from rosproxy.net.addresses import HostPort
from rosproxy_operator.docker.planner.actions import Action, CreateRedirect, Remove, Run
from rosproxy_operator.docker.planner.label_policy import network_owner
from rosproxy_operator.docker.planner.model import (
    STARTED,
    Container,
    Desired,
    HostState,
    Key,
    Member,
    PlanSettings,
    RedirectContainer,
)
from rosproxy_operator.docker.planner.specs import (
    COMMON,
    NFT,
    REDIRECT_USER,
    digest,
    master,
    own_labels,
    proxy_name,
    redirect_name,
)

_SET = Template("""\
table ip $table {
  chain output {
    type nat hook output priority -100; policy accept;
    ip daddr $address tcp dport $port dnat to $proxy:$port
  }
  chain postrouting {
    type nat hook postrouting priority 100; policy accept;
    ip daddr $proxy tcp dport $port ct status dnat ct original ip daddr $address masquerade
  }
}
""")
"""Its source is chosen before the rule leads elsewhere, maybe to another network: so masquerade."""
MEMORY, PIDS = 64 * 1024**2, 16
"""Bytes and threads of what sets the rules: nft has 5 MiB, and one."""
RedirectSite = tuple[Key, str]
"""A proxy's key, and the id of the container whose network a redirect is in."""


@dataclass(frozen=True, slots=True)
class RedirectSteps:
    """What is to be done for one redirect; ``container`` is the name of whom users know it by."""

    key: Key
    container: str
    actions: tuple[Action, ...]


def redirect_config(made: CreateRedirect, settings: PlanSettings) -> dict[str, Any]:
    """The body of the engine's ``POST /containers/create`` for what sets a redirect's rules."""
    return {
        "Image": settings.proxy_image,
        "User": REDIRECT_USER,
        "Entrypoint": [NFT],
        "Cmd": [_rules(made)],
        "Healthcheck": {"Test": ["NONE"]},
        "Labels": own_labels(made),
        "HostConfig": {
            **COMMON,
            "RestartPolicy": {"Name": "no"},
            "CapAdd": ["NET_ADMIN"],
            "Init": False,
            "Memory": MEMORY,
            "PidsLimit": PIDS,
            "NetworkMode": f"container:{made.target}",
        },
    }


def _rules(made: CreateRedirect) -> str:
    """One transaction of nft(8): whatever a redirect has had there goes, and comes as it is now."""
    table = f"rosproxy-redirect-{proxy_name(made.key).rpartition('-')[2]}"
    text = f"add table ip {table}\ndelete table ip {table}\n"
    if made.master is None:
        return text
    to = made.proxy or made.master
    return text + _SET.substitute(
        table=table, address=made.master.host, port=made.master.port, proxy=to.host
    )


def redirect_steps(
    observed: HostState, settings: PlanSettings, desired: Iterable[Desired]
) -> Iterator[RedirectSteps]:
    """What is to be done so that each redirect that is wanted is there, and no other."""
    wanted = _wanted(observed, settings, desired)
    records: dict[RedirectSite, list[RedirectContainer]] = {}
    for one in observed.redirects:
        records.setdefault((one.key, one.container.shares or ""), []).append(one)
    names = {container.id: container.name for container in observed.containers}
    for place in sorted(wanted.keys() | records.keys()):
        there = records.get(place, [])
        if place in wanted:
            made = wanted[place]
            steps = [] if made is None else _set(made, there, observed)
        else:
            steps = _taken_away(place[1], there, observed, settings)
        if steps and not _in_motion(there, observed):
            yield RedirectSteps(place[0], names.get(place[1], place[1][:12]), tuple(steps))


def in_place(observed: HostState, key: Key, owner: Container) -> str:
    """The name of the record of a redirect to a proxy, in a container's own network; or empty.

    It may lead to where the proxy was a moment ago.
    """
    return next(
        (
            one.container.name
            for one in observed.redirects
            if one.key == key and one.done and _is_of(one, owner)
        ),
        "",
    )


def _wanted(
    observed: HostState, settings: PlanSettings, desired: Iterable[Desired]
) -> dict[RedirectSite, CreateRedirect | None]:
    """The redirects that there ought to be; None for one that is to be left as it is.

    Of several proxies for one address, in one network, the first one gets it.
    """
    found: dict[RedirectSite, CreateRedirect | None] = {}
    owned: dict[tuple[str, HostPort], Key] = {}
    by_id = {container.id: container for container in observed.containers}
    for one in desired:
        for member in one.members if one.live else ():
            owner = network_owner(member.container, by_id)
            if member.by_address is None or not {owner.state, member.container.state} <= STARTED:
                continue
            if owned.setdefault((owner.id, member.by_address), one.key) == one.key:
                place = one.key, owner.id
                found[place] = found.get(place) or _made(member, owner, observed, settings)
    return found


def _made(
    member: Member, owner: Container, observed: HostState, settings: PlanSettings
) -> CreateRedirect | None:
    """The redirect of a container; None while its proxy does not run, or is not met."""
    key, to = member.key, _meeting(member, owner, observed)
    if to is None:
        return None
    proxy, ports = to
    made = CreateRedirect("", key, ports, owner.id, owner.started_at, member.by_address, proxy)
    return _named(made, observed, settings)


def _meeting(
    member: Member, owner: Container, observed: HostState
) -> tuple[HostPort, PortRange] | None:
    """Where a container meets its proxy, on the first network that both are on."""
    near = {place.network for place in owner.attachments if place.address} & member.networks
    running = [one for one in observed.proxies_of(member.key) if one.container.state == "running"]
    for proxy in running:
        box = observed.sandbox_of(proxy)
        places = box.container.attachments if box and box.container.state == "running" else ()
        met = sorted((p.network, p.address) for p in places if p.network in near and p.address)
        if box and met:
            return HostPort(met[0][1], master(member.key).port), box.range
    return None


def _named(made: CreateRedirect, observed: HostState, settings: PlanSettings) -> CreateRedirect:
    """The same with what it is made of, and its name by that."""
    body = redirect_config(replace(made, range=PortRange(1, 1)), settings)
    fingerprint = digest({**body, "Image": observed.image_id})
    return replace(made, fingerprint=fingerprint, name=redirect_name(made.key, fingerprint))


def _set(
    made: CreateRedirect, there: Collection[RedirectContainer], observed: HostState
) -> list[Action]:
    """Have these rules, and their record, and then no other record."""
    same = [one for one in there if one.fingerprint == made.fingerprint]
    found = next((one for one in same if one.container.state != "dead"), None)
    steps: list[Action] = []
    if found is None:
        if not observed.image_id:
            return []
        steps += [Remove(one.container.name, "dead") for one in same]
        steps.append(made)
    others = [one for one in there if one.fingerprint != made.fingerprint]
    if found is None or not found.done or others:
        steps.append(Run(made.name))  # others may have been started by hand since, and set theirs
    return [*steps, *(Remove(one.container.name, "outdated") for one in others)]


def _taken_away(
    target: str,
    there: Collection[RedirectContainer],
    observed: HostState,
    settings: PlanSettings,
) -> list[Action]:
    """Take rules away that nobody wants any more, and then their record.

    With a namespace its rules have gone.
    """
    owner = next((one for one in observed.containers if one.id == target), None)
    if owner is None or owner.state not in STARTED:
        return [Remove(one.container.name, "its network is gone") for one in there]
    # Also those of a former start: whoever has started the record since has set its rules anew.
    record = next(iter(there))
    made = CreateRedirect("", record.key, record.range, target, owner.started_at)
    made = _named(made, observed, settings)
    steps = _set(made, there, observed)
    if not steps and not any(one.fingerprint == made.fingerprint for one in there):
        return []  # without an image they stay
    return [*steps, Remove(made.name, "done")]


def _in_motion(there: Iterable[RedirectContainer], observed: HostState) -> bool:
    """Whether the engine is at one of them, so that nothing can be done."""
    return any(
        one.container.state == "removing" or one.container.name in observed.busy for one in there
    )


def _is_of(record: RedirectContainer, owner: Container) -> bool:
    """Whether it is about the network that a container has now."""
    here = owner.id == record.container.shares and owner.started_at == record.started
    return here and owner.state in STARTED
