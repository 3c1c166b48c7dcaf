"""Plan redirects: rules in a container's network that lead the address of a master to the proxy.

If ROS_MASTER_URI has an address, no alias of the proxy helps. So the operator sets a rule of
nftables in the network namespace of the labelled container, as service meshes do. The rule sends
connections to the master's address and port to the proxy instead.

A container of the proxy's image sets the rule. The container joins the namespace, has NET_ADMIN
there, runs ``nft`` once and ends. The container opens no port and reads nothing but its command.

The ended container stays as the record of the rules, since the operator has no disk. The labels of
the record have a hash of the rules, and the start time of the labelled container: each start makes
a new namespace, without rules. If a record differs from the plan, the operator sets the rules again
in a single transaction. If the plan has no redirect any more, the operator deletes the rules, and
then the record. For a master, the rules do not change connections that are open already.

For rmw_zenoh, the operator redirects the addresses of routers in the same way (`zenoh_redirect`).

The operator sets a redirect only to a running proxy. Afterwards, the redirect stays while the proxy
is away. The nodes then reach no master, just as nodes that use the proxy's name.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from string import Template
from typing import Any

from msgspec.structs import replace

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortRange
from rosproxy_operator.docker.planner.actions import Action, CreateRedirect, Remove, Run
from rosproxy_operator.docker.planner.labels.readers import MASTER_URI
from rosproxy_operator.docker.planner.model import (
    STARTED,
    Container,
    Desired,
    HostState,
    Member,
    RedirectContainer,
)
from rosproxy_operator.docker.planner.network_owner import by_reference, network_owner
from rosproxy_operator.docker.planner.specs import (
    NFT,
    helper_config,
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
from rosproxy_operator.proxy_spec.place import ZENOH, Place

# The priorities are the kernel's for destination and source NAT (nf_ip_hook_priorities). In the
# hook output, nat chains see only connections that this network namespace itself opens. No other
# connections need the redirect.
_MASTER_RULES = Template("""\
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
"""The rules for a master. The masquerade is needed, because the kernel chooses the source address
before dnat, and dnat may lead to another network."""
RedirectSite = tuple[Place, str]
"""The place of a proxy, and the id of the container that owns the network of a redirect."""


@dataclass(frozen=True, slots=True)
class RedirectSteps:
    """The steps for a redirect. ``container`` is the name of the network's owner.

    ``fix`` says what users can do if a step fails; empty for the removal of a redirect.
    """

    place: Place
    container: str
    actions: tuple[Action, ...]
    fix: str = ""


def redirect_config(action: CreateRedirect, settings: PlanSettings) -> dict[str, Any]:
    """The body of the engine's ``POST /containers/create`` for a redirect's container."""
    helper = helper_config(settings, f"container:{action.target}")
    if action.place == ZENOH:
        helper["HostConfig"]["Sysctls"] = zenoh_sysctls(bool(action.addresses))
    return {
        **helper,
        "Entrypoint": [NFT],
        "Cmd": [_rules(action)],
        "Labels": own_labels(action),
    }


def _rules(action: CreateRedirect) -> str:
    """A transaction of nft(8) that deletes the redirect's table and creates the table anew.

    Without ``proxy``, the transaction only deletes the table.
    """
    table = f"rosproxy-redirect-{proxy_name(action.place).rpartition('-')[2]}"
    # Add the table first: to delete a missing table is an error, and undoes the whole transaction.
    text = f"add table ip {table}\ndelete table ip {table}\n"
    if action.proxy is None:
        return text
    if action.place == ZENOH:
        return text + zenoh_rules(table, action.addresses, action.proxy)
    (master,) = action.addresses
    return text + _MASTER_RULES.substitute(
        table=table, address=master.host, port=master.port, proxy=action.proxy.host
    )


def redirect_steps(
    observed: HostState, settings: PlanSettings, desired: Iterable[Desired]
) -> Iterator[RedirectSteps]:
    """The steps after which the host has exactly the planned redirects.

    A redirect whose record is busy (`_is_busy`) has no steps in this look.
    """
    wanted = _wanted(observed, settings, desired)
    records: dict[RedirectSite, list[RedirectContainer]] = {}
    for record in observed.redirects:
        records.setdefault((record.place, record.container.network_container or ""), []).append(
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
            fix = _redirect_fix(site[0])
            yield RedirectSteps(site[0], name, tuple(steps), fix if site in wanted else "")


def _redirect_fix(place: Place) -> str:
    """What users can do if the operator can't set a redirect."""
    if place == ZENOH:
        setting = as_client(proxy_name(place))
        until = "Until the redirect is in place, the nodes do not find the proxy"
    else:
        setting = (
            f"ROS_MASTER_URI=http://{proxy_name(place)}:{place.master.port} and the label "
            f"{MASTER_URI}={place.master.uri}"
        )
        until = "Until the redirect is in place, the nodes bypass the proxy"
    return f"Set {setting}; or wait, since the operator tries again. {until}"


def redirect_record_name(observed: HostState, place: Place, owner: Container) -> str:
    """The name of the record of a container's redirect to a proxy; empty without a redirect.

    The redirect may still lead to a former address of the proxy.
    """
    return next(
        (
            record.container.name
            for record in observed.redirects
            if record.place == place and record.done and _is_of(record, owner)
        ),
        "",
    )


def _wanted(
    observed: HostState, settings: PlanSettings, desired: Iterable[Desired]
) -> dict[RedirectSite, CreateRedirect | None]:
    """The planned redirects; None while the container can't reach the proxy: change nothing.

    If several proxies claim an address in a network, the first proxy gets the address.
    """
    wanted: dict[RedirectSite, CreateRedirect | None] = {}
    owners: dict[tuple[str, HostPort], Place] = {}
    ports: Mapping[str, int] = {}
    for proxy in desired:
        redirected = [*_redirected_members(proxy, observed)]
        if proxy.place == ZENOH:
            targets = frozenset(owner.id for _, owner in redirected)
            ports = router_ports(observed.redirects, targets)
            redirected = [*with_all_routers(redirected)]
        for member, owner in redirected:
            if owners.setdefault((owner.id, member.redirected[0]), proxy.place) == proxy.place:
                site = proxy.place, owner.id
                port = ports[owner.id] if proxy.place == ZENOH else proxy.place.master.port
                # Containers that share a network share the redirect.
                wanted[site] = wanted.get(site) or _redirect_to(
                    member, owner, port, observed, settings
                )
    return wanted


def _redirected_members(proxy: Desired, observed: HostState) -> Iterator[tuple[Member, Container]]:
    """The members of a proxy that need a redirect now, each with the owner of the network."""
    containers = by_reference(observed.containers)
    for member in proxy.members if proxy.live else ():
        owner = network_owner(member.container, containers)
        if member.redirected and {owner.state, member.container.state} <= STARTED:
            yield member, owner


def _redirect_to(
    member: Member, owner: Container, port: int, observed: HostState, settings: PlanSettings
) -> CreateRedirect | None:
    """The redirect of a container; None while the container can't reach the proxy's port."""
    reachable = _reachable_proxy(member, owner, observed)
    if reachable is None:
        return None
    proxy, ports = reachable
    if member.place == ZENOH:
        if port not in ports:  # the sandbox is about to get more ports
            return None
        ports = PortRange(port, port)
    action = CreateRedirect(
        "",
        member.place,
        ports,
        owner.id,
        owner.started_at,
        member.redirected,
        HostPort(proxy, port),
    )
    return _with_fingerprint(action, observed, settings)


def _reachable_proxy(
    member: Member, owner: Container, observed: HostState
) -> tuple[str, PortRange] | None:
    """The address and range of the proxy, on the first network that container and proxy share.

    None if the proxy or the sandbox does not run, or without a common network.
    """
    shared = {a.network for a in owner.attachments if a.address} & member.networks
    running = [p for p in observed.proxies_of(member.place) if p.container.state == "running"]
    for proxy in running:
        sandbox = observed.sandbox_of(proxy)
        attachments = (
            sandbox.container.attachments
            if sandbox and sandbox.container.state == "running"
            else ()
        )
        pairs = sorted(
            (a.network, a.address) for a in attachments if a.network in shared and a.address
        )
        if sandbox and pairs:
            return pairs[0][1], sandbox.range
    return None


def _with_fingerprint(
    action: CreateRedirect, observed: HostState, settings: PlanSettings
) -> CreateRedirect:
    """The action with a fingerprint, and with the name by this fingerprint."""
    # The fingerprint leaves out the proxy's range, which is only a label: a longer range changes no
    # rule.
    body = redirect_config(replace(action, range=PortRange(1, 1)), settings)
    fingerprint = digest({**body, "Image": observed.image_id})
    return replace(action, fingerprint=fingerprint, name=redirect_name(action.place, fingerprint))


def _set_steps(
    action: CreateRedirect, records: Collection[RedirectContainer], observed: HostState
) -> list[Action]:
    """The steps that set these rules, keep a record of the rules, and remove all other records.

    No steps if the record is missing and the host does not have the proxy's image.
    """
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
        # With outdated records, run again: a user may have started an outdated record.
        # A user may have renamed the record.
        steps.append(Run(record.container.name if record else action.name))
    return [*steps, *(Remove(r.container.name, "outdated") for r in outdated)]


def _removal_steps(
    target: str,
    records: Collection[RedirectContainer],
    observed: HostState,
    settings: PlanSettings,
) -> list[Action]:
    """The steps that delete the rules of a redirect, and then the records.

    If the container has ended, only the records are left: the kernel deletes the rules with the
    namespace. No steps if the host does not have the proxy's image, which deletes the rules.
    """
    owner = next((c for c in observed.containers if c.id == target), None)
    if owner is None or owner.state not in STARTED:
        return [Remove(r.container.name, "the network namespace is gone") for r in records]
    # Delete rules even if all records are of a former start: a user may have started a record by
    # hand since, and so set the rules again.
    record = next(iter(records))
    action = CreateRedirect("", record.place, record.range, target, owner.started_at)
    action = _with_fingerprint(action, observed, settings)
    steps = _set_steps(action, records, observed)
    if not steps and not any(r.fingerprint == action.fingerprint for r in records):
        return []  # without the image, the operator can't delete the rules
    matching = (r.container for r in records if r.fingerprint == action.fingerprint)
    names = [container.name for container in matching if container.state != "dead"]
    return [*steps, *(Remove(name, "done") for name in names or [action.name])]


def _is_busy(records: Iterable[RedirectContainer], observed: HostState) -> bool:
    """Whether the engine removes a record, or a record has no current inspection."""
    return any(
        r.container.state == "removing" or r.container.name in observed.busy for r in records
    )


def _is_of(record: RedirectContainer, owner: Container) -> bool:
    """Whether a record is of the present network namespace of a container."""
    is_same = owner.id == record.container.network_container and owner.started_at == record.started
    return is_same and owner.state in STARTED
