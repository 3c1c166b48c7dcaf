"""The status of a host as a JSON document, made from a look, a plan, and the answers of proxies.

``status --json`` prints the document, `rosproxy_operator.docker.planner.report` renders the
document as text, and the running operator serves the document at ``/status``.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict
from datetime import datetime

from rosproxy import __version__
from rosproxy.shared.addresses import parse_host_port, plain_address
from rosproxy.shared.documents.status_document import (
    ParticipantStatus,
    ProxyStatus,
    ZenohNodeStatus,
)
from rosproxy.shared.output.text import brief, listed
from rosproxy_operator.common.problem import (
    NOT_WIRED,
    Problem,
)
from rosproxy_operator.common.proxy_client import Json
from rosproxy_operator.common.proxy_status import nodes_by_address, participants_by_address
from rosproxy_operator.common.ros2_variables import MOST_VALUE_CHARACTERS, discovery_obstacle
from rosproxy_operator.common.zenoh import SESSION_FILE
from rosproxy_operator.docker.planner.model import Container, HostState, Member, OwnContainer
from rosproxy_operator.docker.planner.network_owner import by_reference, network_owner
from rosproxy_operator.docker.planner.plan import DockerPlan
from rosproxy_operator.docker.planner.redirect import redirect_record_name
from rosproxy_operator.docker.planner.specs import lan_relay_name, proxy_name, sandbox_name
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.place import ZENOH, Domain, Master, Place

ProxyStatuses = Mapping[str, ProxyStatus]
"""The status of each proxy that answers, by container name."""
PROXY_STARTING_S = 8.0
"""Seconds after the start of a proxy in which a missing answer is no problem."""
NODES_STARTING_S = 15.0
"""Seconds after the start of a container and of its proxy in which missing nodes are no problem."""


def host_document(
    observed: HostState,
    planned: DockerPlan,
    problems: Iterable[Problem],
    answers: Mapping[str, ProxyStatus | Problem],
    settings: PlanSettings,
    now: float,
) -> Json:
    """Return the document.

    ``answers`` has, by name, the status of each running proxy or the problem of a proxy that does
    not answer. ``now`` is Unix time.

    The document lists the members of proxies and the containers with a problem. A container with
    nodes of ROS 1 and ROS 2 is listed twice. No actions are listed for a proxy that has a busy
    container (`HostState`).
    """
    statuses = {name: answer for name, answer in answers.items() if isinstance(answer, ProxyStatus)}
    problems = [*problems]
    subjects = {problem.subject for problem in problems}
    silent = _silent(answers, observed, now)
    problems += [problem for problem in silent if problem.subject not in subjects]
    problems += _undiscovered(planned.members, observed, statuses, now)
    problems += _unconnected(planned.members, observed, statuses, now)
    subjects = {problem.subject for problem in problems}
    redirects = _redirects(planned.members, observed)
    places: dict[str, list[Place | None]] = {}
    for member in planned.members:
        place = member.place if member.place in observed.places else None
        places.setdefault(member.container.id, []).append(place)
    return {
        "version": __version__,
        "uplink": settings.uplink,
        "proxies": [
            _proxy(place, observed, statuses, settings) for place in sorted(observed.places)
        ],
        "containers": [
            _container(container, place, observed, statuses, redirects.get((container.id, place)))
            for container in observed.containers
            if container.id in places or f"container {container.name}" in subjects
            for place in places.get(container.id, [None])
        ],
        "problems": [asdict(problem) for problem in problems],
        "actions": [
            str(action)
            for group in (*planned.groups, *planned.deferred)
            for action in group.actions
        ],
    }


def _proxy(
    place: Place, observed: HostState, statuses: ProxyStatuses, settings: PlanSettings
) -> Json:
    """Return the row of a proxy. Faults of the sandbox and the LAN relay are in ``problems``."""
    proxy = _best(observed.proxies_of(place), proxy_name(place))
    sandbox = _best(observed.sandboxes_of(place), sandbox_name(place))
    own = sandbox or proxy
    graph = place.graph
    sandbox_state = sandbox.container.state if sandbox else "absent"
    status = statuses.get(proxy.container.name) if proxy else None
    problems = [f"{p.subject}: {p.text}" for p in (status.problems if status else ())]
    if sandbox_state != "running":
        subject = f"the container {sandbox_name(place)}, which holds the proxy's ports and networks"
        problems.insert(0, f"{subject}, is {sandbox_state}")
    lan_relay = _best(observed.lan_relays_of(place), lan_relay_name(place))
    if lan_relay and lan_relay.container.state != "running":
        problems.append(
            f"the container {lan_relay_name(place)}, the proxy's LAN relay, is "
            f"{lan_relay.container.state}"
        )
    domain = status.domains[0] if status and status.domains else None
    zenoh = status.zenoh if status else None
    return {
        "name": proxy_name(place),
        "ros": graph.ros,
        "domain": graph.number if isinstance(graph, Domain) else None,
        "peers": list(domain.peers) if domain else [],
        "links": {link.title: link.up for link in zenoh.links} if zenoh else {},
        "lan_relay": lan_relay.container.state if lan_relay else None,
        "master_uri": graph.uri if isinstance(graph, Master) else "",
        "master_address": (status.master.address if status else None) or "",
        "master_up": status.master.up if status and isinstance(graph, Master) else None,
        "advertise_host": place.advertise_host,
        "range": str(own.range) if own else "",
        "state": proxy.container.state if proxy else "absent",
        "reachable": status is not None,
        "networks": sorted(sandbox.container.networks - {settings.uplink}) if sandbox else [],
        "data_plane": status.data_plane.plane if status and status.data_plane else None,
        "used": status.ports.used if status and place != ZENOH else None,
        "free": status.ports.free if status and place != ZENOH else None,
        "reached": status.range_probe.reached if status and status.range_probe else None,
        "problems": problems,
    }


def _best(containers: Iterable[OwnContainer], name: str) -> OwnContainer | None:
    """Return a running container, else any, preferably of this name; None without containers."""
    return min(
        containers,
        key=lambda own: (own.container.state != "running", own.container.name != name),
        default=None,
    )


def _participant(participant: ParticipantStatus) -> Json:
    return {
        "guid_prefix": participant.guid_prefix,
        "vendor": participant.vendor,
        "address": participant.address,
        "nodes": list(participant.nodes),
        "ports": [lease.port for lease in participant.leases],
        "publishes": list(participant.publishes),
        "subscribes": list(participant.subscribes),
        "services": list(participant.services),
        "problem": participant.problem,
    }


def _zenoh_node(node: ZenohNodeStatus) -> Json:
    return {
        "name": node.name,
        "domain": node.domain,
        "publishes": list(node.publishes),
        "subscribes": list(node.subscribes),
        "services": list(node.services),
    }


def _redirects(
    members: Iterable[Member], observed: HostState
) -> dict[tuple[str, Place | None], Json]:
    """Return the planned redirects of living containers, by container id and place of the proxy."""
    containers = by_reference(observed.containers)
    return {
        (member.container.id, member.place): {
            "master": listed(map(str, member.redirected)),
            "in_place": bool(
                redirect_record_name(
                    observed, member.place, network_owner(member.container, containers)
                )
            ),
        }
        for member in members
        if member.redirected and member.container.alive
    }


def container_names(observed: HostState) -> dict[str, str]:
    """Return the names of the living containers by address: a list as text if several share one."""
    by_id = {container.id: container for container in observed.containers}
    names: defaultdict[str, dict[str, None]] = defaultdict(dict)
    for container in observed.containers:
        for attachment in network_owner(container, by_id).attachments:
            if container.alive and attachment.address:
                names[plain_address(attachment.address)][container.name] = None
    return {address: listed(group) for address, group in names.items()}


def just_started(observed: HostState, now: float) -> frozenset[str]:
    """Return the names of proxies started in the last `PROXY_STARTING_S`; ``now`` is Unix time."""
    containers = (proxy.container for proxy in observed.proxies)
    ages = {container.name: now - _unix_time(container.started_at) for container in containers}
    # If the clock of the engine's machine is ahead, the age is negative and says nothing.
    return frozenset(name for name, age in ages.items() if 0 <= age < PROXY_STARTING_S)


def _silent(
    answers: Mapping[str, ProxyStatus | Problem], observed: HostState, now: float
) -> list[Problem]:
    """Return the problems of proxies that do not answer, except proxies that have just started."""
    starting = just_started(observed, now)
    return [
        answer
        for name, answer in answers.items()
        if isinstance(answer, Problem) and name not in starting
    ]


def _undiscovered(
    members: Iterable[Member], observed: HostState, statuses: ProxyStatuses, now: float
) -> Iterator[Problem]:
    """Yield problems for ROS 2 containers without participants, if variables may be the cause.

    A variable alone is no problem, since the operator does not read DDS profiles.
    """
    for member in members:
        container = member.container
        status = statuses.get(proxy_name(member.place))
        if (
            not isinstance(member.place.graph, Domain)
            or status is None
            or container.state != "running"
        ):
            continue
        settled = _is_settled(container, status, now)
        addresses = _addresses(container, observed).values()
        obstacle = discovery_obstacle(container.variables)
        if obstacle and settled and not participants_by_address(status).keys() & {*addresses}:
            text = (
                "the proxy has discovered no participant of this container. Possible cause, if a "
                f"participant runs: {obstacle.text}"
            )
            yield Problem(
                f"container {container.name}",
                text,
                obstacle.fix,
                fatal=False,
                reason=NOT_WIRED,
            )


def _unconnected(
    members: Iterable[Member], observed: HostState, statuses: ProxyStatuses, now: float
) -> Iterator[Problem]:
    """Yield a problem for each container that has a session file for zenoh, but no session."""
    for member in members:
        container = member.container
        status = statuses.get(proxy_name(member.place))
        file = container.variables.get(SESSION_FILE, "")
        if not file or not member.redirected or not status or not status.zenoh:
            continue
        remotes = (parse_host_port(session.remote) for session in status.zenoh.sessions)
        hosts = {remote.host for remote in remotes if remote}
        addresses = {*_addresses(container, observed).values()}
        if _is_settled(container, status, now) and not hosts & addresses:
            yield Problem(
                f"container {container.name}",
                "no node of this container has connected to the proxy. Possible cause: variable "
                f"{SESSION_FILE}={brief(file, MOST_VALUE_CHARACTERS)}. The file may name other "
                "endpoints than tcp/localhost:7447",
                "Unset the variable, or change the file",
                fatal=False,
                reason=NOT_WIRED,
            )


def _is_settled(container: Container, status: ProxyStatus, now: float) -> bool:
    """Return whether a container and the proxy have both run for NODES_STARTING_S seconds."""
    age = now - _unix_time(container.started_at)
    return container.state == "running" and min(status.uptime, age) >= NODES_STARTING_S


def _unix_time(text: str) -> float:
    """Return a time of the engine as Unix time; 0 for a text that is no time."""
    try:
        seconds = text.partition(".")[0].removesuffix("Z")
        return datetime.fromisoformat(f"{seconds}+00:00").timestamp()
    except ValueError:
        return 0.0


def _addresses(container: Container, observed: HostState) -> dict[str, str]:
    """Return the addresses by network, of the container that owns the network namespace."""
    owner = network_owner(container, by_reference(observed.containers))
    return {a.network: a.address for a in owner.attachments if a.address}


def _container(
    container: Container,
    place: Place | None,
    observed: HostState,
    statuses: ProxyStatuses,
    redirect: Json | None = None,
) -> Json:
    proxy = proxy_name(place) if place else None
    addresses = _addresses(container, observed)
    status = statuses.get(proxy or "")
    nodes = nodes_by_address(status) if status else {}
    participants = participants_by_address(status) if status else {}
    return {
        "name": container.name,
        "state": container.state,
        "proxy": proxy,
        "ros": place.graph.ros if place else None,
        "participants": [
            _participant(p)
            for address in dict.fromkeys(addresses.values())
            for p in participants.get(address, ())
        ],
        "zenoh_nodes": [
            _zenoh_node(node)
            for node in (status.zenoh.nodes if status and status.zenoh else ())
            if node.address in addresses.values()
        ],
        "redirect": redirect,
        "networks": sorted(container.networks),
        "addresses": addresses,
        "nodes": [
            {
                "names": list(node.nodes),
                "address": node.address,
                "advertised_uri": node.advertised_uri,
                "state": node.state,
            }
            for address in dict.fromkeys(addresses.values())
            for node in nodes.get(address, ())
        ],
    }
