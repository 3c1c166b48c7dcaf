"""What there is on a host, for ``status`` and ``plan``: found out without a running operator."""

import asyncio
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from rosproxy import __version__
from rosproxy.admin.status_document import ProxyStatus
from rosproxy.net.addresses import HostPort
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.common.proxy_client import Json, ProxyClient, ProxyError
from rosproxy_operator.common.proxy_status import nodes_by_address
from rosproxy_operator.common.resolver import MasterResolver
from rosproxy_operator.docker.client import DockerClient
from rosproxy_operator.docker.planner.actions import Action
from rosproxy_operator.docker.planner.model import Container, Key, PlanSettings, Proxy, Sandbox
from rosproxy_operator.docker.planner.plan import DockerPlan, plan
from rosproxy_operator.docker.planner.specs import proxy_name, sandbox_name
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.docker.proxy_sync import silence
from rosproxy_operator.docker.snapshot import DockerObserver, DockerSnapshot

Own = TypeVar("Own", Proxy, Sandbox)
PATIENCE = 3.0
"""Seconds that are waited for inspections: nobody looks a second time."""


@dataclass(frozen=True, slots=True)
class Survey:
    """One look at a host, what would be done there, and what its proxies say, by name."""

    look: DockerSnapshot
    plan: DockerPlan
    said: Mapping[str, ProxyStatus | ProxyError]
    problems: tuple[Problem, ...]

    def answer(self, proxy: str) -> ProxyStatus | None:
        """What a proxy says of itself, by its container's name; None if it does not answer."""
        said = self.said.get(proxy)
        return None if isinstance(said, ProxyError) else said

    @property
    def actions(self) -> list[Action]:
        """What would be done, but for what the engine is busy with and tells nothing of."""
        groups = (*self.plan.groups, *self.plan.deferred)
        return [action for group in groups for action in group.actions]


async def survey(settings: PlanSettings) -> Survey:
    """Look at the engine and ask all proxies. Raises EngineError."""
    engine, masters, proxies = DockerClient(), MasterResolver(_nothing), ProxyClient()
    observer = DockerObserver(engine, settings, masters, _nothing)
    try:
        look = await observer.look(PATIENCE)
        planned = plan(look.state, look.labels, settings, DockerMemory(), time.monotonic())
        ways = look.access.values()
        answers = await asyncio.gather(*(_ask(proxies, access.admin) for access in ways))
    finally:
        await proxies.close()
    said = dict(zip(look.access, answers, strict=True))
    silent = [
        silence(name, answer, look, settings.uplink)
        for name, answer in said.items()
        if isinstance(answer, ProxyError)
    ]
    return Survey(look, planned, said, (*planned.problems, *silent))


def describe(found: Survey, settings: PlanSettings) -> Json:
    """A survey as JSON: what `rosproxy_operator.docker.planner.report.render` shows."""
    observed = found.look.state
    keys = {
        member.container.id: member.key
        for member in found.plan.members
        if member.key in observed.keys
    }
    listed = [c for c in observed.containers if c.id in keys or _meant(c, found)]
    return {
        "version": __version__,
        "uplink": settings.uplink,
        "proxies": [_proxy(key, found, settings) for key in sorted(observed.keys)],
        "containers": [_container(c, _name(keys.get(c.id)), found) for c in listed],
        "problems": [
            {"subject": problem.subject, "text": problem.text, "fatal": problem.fatal}
            for problem in found.problems
        ],
        "actions": [str(action) for action in found.actions],
    }


def _name(key: Key | None) -> str | None:
    return proxy_name(key) if key else None


def _proxy(key: Key, found: Survey, settings: PlanSettings) -> Json:
    """One row per proxy; its sandbox is only told of where it is what is wrong."""
    observed, name = found.look.state, proxy_name(key)
    process = _best(observed.proxies_of(key), name)
    box = _best(observed.sandboxes_of(key), sandbox_name(key))
    said = found.answer(process.container.name) if process else None
    own = box or process
    networks = box.container.networks if box else frozenset()
    return {
        "name": name,
        "master_uri": key.master_uri,
        "master_address": (said.master.address if said else None) or "",
        "master_up": said.master.up if said else None,
        "advertise_host": key.advertise_host,
        "range": str(own.range) if own else "",
        "state": process.container.state if process else "absent",
        "reachable": said is not None,
        "networks": sorted(networks - {settings.uplink}),
        "data_plane": said.data_plane.plane if said and said.data_plane else None,
        "used": said.ports.used if said else None,
        "free": said.ports.free if said else None,
        "problems": [
            *_amiss(box, sandbox_name(key)),
            *(f"{one.subject}: {one.text}" for one in (said.problems if said else ())),
        ],
    }


def _best(found: Sequence[Own], name: str) -> Own | None:
    """The one that is called so, if it runs; else any that runs; else any."""
    ranked = sorted(found, key=lambda o: (o.container.state != "running", o.container.name != name))
    return ranked[0] if ranked else None


def _amiss(box: Sandbox | None, name: str) -> Iterator[str]:
    state = box.container.state if box else "absent"
    if state != "running":
        yield f"the container {name}, which holds its ports and networks, is {state}"


def _container(container: Container, proxy: str | None, found: Survey) -> Json:
    addresses = {a.network: a.address for a in container.attachments if a.address}
    answer = found.answer(proxy or "")
    nodes = nodes_by_address(answer) if answer else {}
    return {
        "name": container.name,
        "state": container.state,
        "proxy": proxy,
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


def _meant(container: Container, found: Survey) -> bool:
    """Whether something is wrong with a container's labels."""
    return any(problem.subject == f"container {container.name}" for problem in found.problems)


async def _ask(proxies: ProxyClient, where: HostPort) -> ProxyStatus | ProxyError:
    try:
        return await proxies.status(where)
    except ProxyError as error:
        return error


def _nothing() -> None:
    """Nobody has to be woken."""
