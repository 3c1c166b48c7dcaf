"""The commands ``status`` and ``plan``: what there is on a host, without a running operator.

Their exit codes tell scripts: of ``status`` 0 if all is as wanted, of ``plan`` 0 if nothing is to
be done and STEPS_LEFT if something is; 1 of both if something is wrong.
"""

import asyncio
import json
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict

from rosproxy import __version__
from rosproxy.admin.status_document import ParticipantStatus, ProxyStatus
from rosproxy.cli.terminal import size, watch, write
from rosproxy_operator.common.master_resolver import MasterResolver
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.common.proxy_client import Json, ProxyClient, ProxyError
from rosproxy_operator.common.proxy_status import nodes_by_address, participants_by_address
from rosproxy_operator.docker.engine_client import DockerClient
from rosproxy_operator.docker.errors import EngineError
from rosproxy_operator.docker.planner.label_policy import network_owner
from rosproxy_operator.docker.planner.model import Container, HostState, Key, Member, OwnContainer
from rosproxy_operator.docker.planner.plan import plan
from rosproxy_operator.docker.planner.redirect import redirect_record_name
from rosproxy_operator.docker.planner.report import render
from rosproxy_operator.docker.planner.specs import ear_name, proxy_name, sandbox_name
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.docker.proxy_sync import silence
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.docker.snapshot import DockerObserver, DockerSnapshot

ProxyStatuses = Mapping[str, ProxyStatus]
"""The status of each proxy that answers, by the name of its container."""
STEPS_LEFT = 3
"""The exit code of ``plan`` if there is something to do."""
WAIT_INTERVAL = 1.0
"""Seconds between two looks of ``--wait``."""
PATIENCE = 3.0
"""Seconds to wait for inspections: there is no second look."""


def show_plan(settings: PlanSettings, as_json: bool, wait: float) -> int:
    """Print what would be done now, and what is wrong; the exit code. Raises EngineError.

    ``wait`` are the seconds in which there may come to be nothing to do.
    """
    status = _await(settings, wait, lambda status: not status["actions"])
    shown = {key: status[key] for key in ("actions", "problems")}
    if as_json:
        write(json.dumps(shown, indent=2))
    else:
        write("\n".join(status["actions"]) or "Nothing to do.")
        for problem in status["problems"]:
            write(f"{problem['subject']}: {problem['text']}")
    return STEPS_LEFT if status["actions"] else int(_is_wrong(status))


def show_status(settings: PlanSettings, as_json: bool, wait: float) -> int:
    """Print what there is on the host; the exit code. Raises EngineError.

    ``wait`` are the seconds in which all may come to be as wanted.
    """
    status = _await(settings, wait, _is_as_wanted)
    write(json.dumps(status, indent=2) if as_json else render(status, size()[0]))
    return int(not _is_as_wanted(status))


def _await(settings: PlanSettings, seconds: float, good: Callable[[Json], bool]) -> Json:
    """A survey that is good, or the last one after so many seconds. Raises EngineError."""
    end = time.monotonic() + seconds
    while not good(status := asyncio.run(survey(settings))) and time.monotonic() < end:
        time.sleep(WAIT_INTERVAL)
    return status


def _is_as_wanted(status: Json) -> bool:
    """Whether nothing is left to do, nothing is wrong, and every proxy answers."""
    silent = [proxy for proxy in status["proxies"] if not proxy["reachable"]]
    return not status["actions"] and not silent and not _is_wrong(status)


def _is_wrong(status: Json) -> bool:
    return any(problem["fatal"] for problem in status["problems"])


def watch_status(settings: PlanSettings) -> None:
    """Draw the status again and again until interrupted, also while no engine answers."""

    def draw(columns: int, lines: int | None) -> str:
        try:
            return render(asyncio.run(survey(settings)), columns, lines)
        except EngineError as error:
            return f"{time.strftime('%H:%M:%S')} {error}"

    watch(draw)


async def survey(settings: PlanSettings) -> Json:
    """What there is, what would be done, and what the proxies say. Raises EngineError.

    Containers are those that have a proxy or whose labels are wrong; one with both versions of ROS
    is listed twice. Actions for what the engine is busy with, and tells nothing of, are left out.
    """
    proxies = ProxyClient()
    # Nobody has to be woken: there is no second look.
    observer = DockerObserver(DockerClient(), settings, MasterResolver(lambda: None), lambda: None)
    try:
        snapshot = await observer.look(PATIENCE)
        planned = plan(snapshot.state, snapshot.labels, settings, DockerMemory(), time.monotonic())
        calls = (_ask(proxies, name, snapshot, settings.uplink) for name in snapshot.access)
        answers = dict(zip(snapshot.access, await asyncio.gather(*calls), strict=True))
    finally:
        await proxies.close()
    statuses = {name: answer for name, answer in answers.items() if isinstance(answer, ProxyStatus)}
    silent = [answer for answer in answers.values() if isinstance(answer, Problem)]
    problems = [*planned.problems, *silent]
    subjects = {problem.subject for problem in problems}
    redirects = _redirects(planned.members, snapshot.state)
    keys: dict[str, list[Key]] = {}
    for member in planned.members:
        if member.key in snapshot.state.keys:
            keys.setdefault(member.container.id, []).append(member.key)
    return {
        "version": __version__,
        "uplink": settings.uplink,
        "proxies": [
            _proxy(key, snapshot.state, statuses, settings) for key in sorted(snapshot.state.keys)
        ],
        "containers": [
            _container(container, key, statuses, redirects.get((container.id, key)))
            for container in snapshot.state.containers
            if container.id in keys or f"container {container.name}" in subjects
            for key in keys.get(container.id, [None])
        ],
        "problems": [asdict(problem) for problem in problems],
        "actions": [
            str(action)
            for group in (*planned.groups, *planned.deferred)
            for action in group.actions
        ],
    }


async def _ask(
    proxies: ProxyClient, name: str, snapshot: DockerSnapshot, uplink: str
) -> ProxyStatus | Problem:
    try:
        return await proxies.status(snapshot.access[name].admin)
    except ProxyError as error:
        return silence(name, error, snapshot, uplink)


def _proxy(key: Key, observed: HostState, statuses: ProxyStatuses, settings: PlanSettings) -> Json:
    """One row per proxy; its sandbox is only mentioned where that is what is wrong."""
    proxy = _best(observed.proxies_of(key), proxy_name(key))
    sandbox = _best(observed.sandboxes_of(key), sandbox_name(key))
    own = sandbox or proxy
    sandbox_state = sandbox.container.state if sandbox else "absent"
    status = statuses.get(proxy.container.name) if proxy else None
    problems = [f"{p.subject}: {p.text}" for p in (status.problems if status else ())]
    if sandbox_state != "running":
        subject = f"the container {sandbox_name(key)}, which holds its ports and networks"
        problems.insert(0, f"{subject}, is {sandbox_state}")
    ear = _best(observed.ears_of(key), ear_name(key))
    if ear and ear.container.state != "running":
        problems.append(f"the container {ear_name(key)}, its ear, is {ear.container.state}")
    domain = status.domains[0] if status and status.domains else None
    return {
        "name": proxy_name(key),
        "ros": "2" if key.is_ros2 else "1",
        "domain": key.domain,
        "peers": list(domain.peers) if domain else [],
        "ear": ear.container.state if ear else None,
        "master_uri": key.master_uri,
        "master_address": (status.master.address if status else None) or "",
        "master_up": status.master.up if status else None,
        "advertise_host": key.advertise_host,
        "range": str(own.range) if own else "",
        "state": proxy.container.state if proxy else "absent",
        "reachable": status is not None,
        "networks": sorted(sandbox.container.networks - {settings.uplink}) if sandbox else [],
        "data_plane": status.data_plane.plane if status and status.data_plane else None,
        "used": status.ports.used if status else None,
        "free": status.ports.free if status else None,
        "problems": problems,
    }


def _best(containers: Iterable[OwnContainer], name: str) -> OwnContainer | None:
    """The container of this name, if it runs; else any that runs; else any."""
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
        "ports": [lease.port for lease in participant.leases],
        "publishes": list(participant.publishes),
        "subscribes": list(participant.subscribes),
        "services": list(participant.services),
        "problem": participant.problem,
    }


def _redirects(
    members: Iterable[Member], observed: HostState
) -> dict[tuple[str, Key | None], Json]:
    """The redirects in containers' networks, by container and proxy."""
    by_id = {container.id: container for container in observed.containers}
    return {
        (member.container.id, member.key): {
            "master": str(member.redirected_master),
            "in_place": bool(
                redirect_record_name(observed, member.key, network_owner(member.container, by_id))
            ),
        }
        for member in members
        if member.redirected_master and member.container.alive
    }


def _container(
    container: Container, key: Key | None, statuses: ProxyStatuses, redirect: Json | None = None
) -> Json:
    proxy = proxy_name(key) if key else None
    addresses = {a.network: a.address for a in container.attachments if a.address}
    status = statuses.get(proxy or "")
    nodes = nodes_by_address(status) if status else {}
    participants = participants_by_address(status) if status else {}
    return {
        "name": container.name,
        "state": container.state,
        "proxy": proxy,
        "ros": ("2" if key.is_ros2 else "1") if key else None,
        "participants": [
            _participant(p)
            for address in dict.fromkeys(addresses.values())
            for p in participants.get(address, ())
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
