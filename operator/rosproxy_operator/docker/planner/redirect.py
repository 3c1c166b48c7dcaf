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

The routers that nodes of rmw_zenoh look for lead to the proxy in the same way (`zenoh_redirect`).

A redirect is only set towards a proxy that runs. Once set, it stays while the proxy is away for a
moment: its nodes then reach nothing, as they would by a name.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from string import Template
from typing import Any

from msgspec.structs import replace

from rosproxy.leases.ports import PortRange
from rosproxy.net.addresses import HostPort
from rosproxy_operator.docker.planner.actions import Action, CreateRedirect, Remove, Run
from rosproxy_operator.docker.planner.label_policy import network_owner
from rosproxy_operator.docker.planner.labels.readers import MASTER_URI
from rosproxy_operator.docker.planner.model import (
    STARTED,
    ZENOH,
    Container,
    Desired,
    HostState,
    Key,
    Member,
    RedirectContainer,
)
from rosproxy_operator.docker.planner.specs import (
    NFT,
    helper_config,
    master,
    own_labels,
    proxy_name,
    redirect_name,
)
from rosproxy_operator.docker.planner.zenoh_redirect import (
    as_client,
    router_ports,
    with_all_routers,
    zenoh_rules,
    zenoh_sysctls,
)
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.fingerprint import digest

# The priorities are those of destination and source NAT (nf_ip_hook_priorities in the kernel). In
# the hook output, nat chains see what this network namespace itself opens, which is enough here.
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
"""The source address is chosen before dnat, which may lead to another network: so masquerade."""
RedirectSite = tuple[Key, str]
"""A proxy's key, and the id of the container whose network a redirect is in."""


@dataclass(frozen=True, slots=True)
class RedirectSteps:
    """What is to be done for one redirect; ``container`` names the one whose network it is in.

    ``fix`` is what its user can do where that fails; empty where a redirect is taken away.
    """

    key: Key
    container: str
    actions: tuple[Action, ...]
    fix: str = ""


def redirect_config(action: CreateRedirect, settings: PlanSettings) -> dict[str, Any]:
    """The body of the engine's ``POST /containers/create`` for what sets a redirect's rules."""
    helper = helper_config(settings, f"container:{action.target}")
    if action.key == ZENOH:
        helper["HostConfig"]["Sysctls"] = zenoh_sysctls(bool(action.addresses))
    return {
        **helper,
        "Entrypoint": [NFT],
        "Cmd": [_rules(action)],
        "Labels": own_labels(action),
    }


def _rules(action: CreateRedirect) -> str:
    """One transaction of nft(8): whatever a redirect has had there goes, and comes as it is now."""
    table = f"rosproxy-redirect-{proxy_name(action.key).rpartition('-')[2]}"
    # To delete a table that is not there is an error, and would undo the transaction: so add first.
    text = f"add table ip {table}\ndelete table ip {table}\n"
    if action.proxy is None:
        return text
    if action.key == ZENOH:
        return text + zenoh_rules(table, action.addresses, action.proxy)
    (master,) = action.addresses
    return text + _SET.substitute(
        table=table, address=master.host, port=master.port, proxy=action.proxy.host
    )


def redirect_steps(
    observed: HostState, settings: PlanSettings, desired: Iterable[Desired]
) -> Iterator[RedirectSteps]:
    """What is to be done so that each redirect that is wanted is there, and no other."""
    wanted = _wanted(observed, settings, desired)
    records: dict[RedirectSite, list[RedirectContainer]] = {}
    for record in observed.redirects:
        records.setdefault((record.key, record.container.network_container or ""), []).append(
            record
        )
    names = {container.id: container.name for container in observed.containers}
    for site in sorted(wanted.keys() | records.keys()):
        existing = records.get(site, [])
        if site in wanted:
            action = wanted[site]
            steps = [] if action is None else _set_steps(action, existing, observed)
        else:
            steps = _removal_steps(site[1], existing, observed, settings)
        if steps and not _is_busy(existing, observed):
            name = names.get(site[1], site[1][:12])
            fix = _by_name(site[0])
            yield RedirectSteps(site[0], name, tuple(steps), fix if site in wanted else "")


def _by_name(key: Key) -> str:
    """How nodes use their proxy where no redirect can be set."""
    if key == ZENOH:
        return (
            "Until the redirect is in place, the nodes do not find the proxy. The operator tries "
            f"again; or set {as_client(proxy_name(key))}"
        )
    return (
        "Until the redirect is in place, the nodes bypass the proxy. The operator tries again; or "
        f"set ROS_MASTER_URI=http://{proxy_name(key)}:{master(key).port} and the label "
        f"{MASTER_URI}={key.master_uri}"
    )


def redirect_record_name(observed: HostState, key: Key, owner: Container) -> str:
    """The name of the record of a redirect to a proxy, in a container's own network; or empty.

    It may lead to where the proxy was a moment ago.
    """
    return next(
        (
            record.container.name
            for record in observed.redirects
            if record.key == key and record.done and _is_of(record, owner)
        ),
        "",
    )


def _wanted(
    observed: HostState, settings: PlanSettings, desired: Iterable[Desired]
) -> dict[RedirectSite, CreateRedirect | None]:
    """The redirects that there ought to be; None for one that is to be left as it is.

    Of several proxies for one address, in one network, the first one gets it.
    """
    wanted: dict[RedirectSite, CreateRedirect | None] = {}
    owners: dict[tuple[str, HostPort], Key] = {}
    ports: Mapping[str, int] = {}
    for proxy in desired:
        started = [*_started(proxy, observed)]
        if proxy.key == ZENOH:
            targets = frozenset(owner.id for _, owner in started)
            ports = router_ports(observed.redirects, targets)
            started = [*with_all_routers(started)]
        for member, owner in started:
            if owners.setdefault((owner.id, member.redirected[0]), proxy.key) == proxy.key:
                site = proxy.key, owner.id
                port = ports[owner.id] if proxy.key == ZENOH else master(proxy.key).port
                # Containers that share a network share the redirect.
                wanted[site] = wanted.get(site) or _redirect_to(
                    member, owner, port, observed, settings
                )
    return wanted


def _started(proxy: Desired, observed: HostState) -> Iterator[tuple[Member, Container]]:
    """The containers of a proxy that are to be redirected now, and whose network each is in."""
    by_id = {container.id: container for container in observed.containers}
    for member in proxy.members if proxy.live else ():
        owner = network_owner(member.container, by_id)
        if member.redirected and {owner.state, member.container.state} <= STARTED:
            yield member, owner


def _redirect_to(
    member: Member, owner: Container, port: int, observed: HostState, settings: PlanSettings
) -> CreateRedirect | None:
    """The redirect of a container; None while its proxy does not run, or is not met."""
    meeting = _meeting(member, owner, observed)
    if meeting is None:
        return None
    proxy, ports = meeting
    if member.key == ZENOH:
        if port not in ports:  # the proxy is about to get more ports
            return None
        ports = PortRange(port, port)
    action = CreateRedirect(
        "",
        member.key,
        ports,
        owner.id,
        owner.started_at,
        member.redirected,
        HostPort(proxy, port),
    )
    return _with_fingerprint(action, observed, settings)


def _meeting(member: Member, owner: Container, observed: HostState) -> tuple[str, PortRange] | None:
    """Where a container meets its proxy, on the first network that both are on."""
    shared = {a.network for a in owner.attachments if a.address} & member.networks
    running = [p for p in observed.proxies_of(member.key) if p.container.state == "running"]
    for proxy in running:
        box = observed.sandbox_of(proxy)
        places = box.container.attachments if box and box.container.state == "running" else ()
        pairs = sorted((p.network, p.address) for p in places if p.network in shared and p.address)
        if box and pairs:
            return pairs[0][1], box.range
    return None


def _with_fingerprint(
    action: CreateRedirect, observed: HostState, settings: PlanSettings
) -> CreateRedirect:
    """The same with what it is made of, and its name by that."""
    # The proxy's range is a label alone, and no part of the rules: a longer range changes nothing.
    body = redirect_config(replace(action, range=PortRange(1, 1)), settings)
    fingerprint = digest({**body, "Image": observed.image_id})
    return replace(action, fingerprint=fingerprint, name=redirect_name(action.key, fingerprint))


def _set_steps(
    action: CreateRedirect, records: Collection[RedirectContainer], observed: HostState
) -> list[Action]:
    """Have these rules, and their record, and then no other record."""
    matching = [r for r in records if r.fingerprint == action.fingerprint]
    record = next((r for r in matching if r.container.state != "dead"), None)
    steps: list[Action] = []
    if record is None:
        if not observed.image_id:
            return []
        steps += [Remove(r.container.name, "dead") for r in matching]
        steps.append(action)
    outdated = [r for r in records if r.fingerprint != action.fingerprint]
    if record is None or not record.done or outdated:
        steps.append(Run(action.name))  # others may have been started by hand since, and set theirs
    return [*steps, *(Remove(r.container.name, "outdated") for r in outdated)]


def _removal_steps(
    target: str,
    records: Collection[RedirectContainer],
    observed: HostState,
    settings: PlanSettings,
) -> list[Action]:
    """Take rules away that nobody wants any more, and then their record.

    With a namespace its rules have gone.
    """
    owner = next((c for c in observed.containers if c.id == target), None)
    if owner is None or owner.state not in STARTED:
        return [Remove(r.container.name, "the network namespace is gone") for r in records]
    # Also those of a former start: whoever has started the record since has set its rules anew.
    record = next(iter(records))
    action = CreateRedirect("", record.key, record.range, target, owner.started_at)
    action = _with_fingerprint(action, observed, settings)
    steps = _set_steps(action, records, observed)
    if not steps and not any(r.fingerprint == action.fingerprint for r in records):
        return []  # without an image they stay
    return [*steps, Remove(action.name, "done")]


def _is_busy(records: Iterable[RedirectContainer], observed: HostState) -> bool:
    """Whether the engine is busy with one of them, so that nothing can be done."""
    return any(
        r.container.state == "removing" or r.container.name in observed.busy for r in records
    )


def _is_of(record: RedirectContainer, owner: Container) -> bool:
    """Whether it is about the network that a container has now."""
    is_same = owner.id == record.container.network_container and owner.started_at == record.started
    return is_same and owner.state in STARTED
