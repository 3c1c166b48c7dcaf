"""News of containers, and the end of a proxy: what a controller tells the admin endpoint."""

import asyncio
import logging
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rosproxy.admin import requests
from rosproxy.leases.leases import Leases
from rosproxy.net.addresses import HostPort
from rosproxy.ros1.clients.master import MasterError, Unreachable
from rosproxy.ros1.clients.node import NodeClient, SelfDescription
from rosproxy.ros1.context import Context
from rosproxy.ros1.registry.endpoint import Endpoint, Place
from rosproxy.ros1.registry.health import ProbeResult
from rosproxy.ros1.upkeep.adoption.adopter import Adopter
from rosproxy.ros1.upkeep.containers import policy
from rosproxy.ros1.upkeep.registrar import Registrar

log = logging.getLogger(__name__)

GONE_TIMEOUT = 0.5
"""Seconds that a node has to answer at an address that is said to be gone."""
YOUNG = 3.0
"""Seconds since its last registration in which a silent node gets a second chance."""
SECOND_CHANCE = 1.0
"""Seconds after which it gets it."""
RETIRE_TIMEOUT = 3.0
"""Seconds that registrations under way get to end before a proxy retires."""


@dataclass(frozen=True, slots=True)
class Parts:
    """What news is acted on with; ``cut`` ends the TCPROS connections through a port."""

    context: Context
    leases: Leases[Endpoint]
    nodes: NodeClient
    upkeep: Registrar
    strays: Adopter
    recovered: Callable[[], Awaitable[None]]
    cut: Callable[[int], None]


class ContainerEvents:
    """Acts on what a controller knows of containers before any time-out can tell."""

    def __init__(self, parts: Parts) -> None:
        self._parts, self._context = parts, parts.context
        self._one_at_a_time = asyncio.Lock()

    async def hear(self, body: Any) -> dict[str, Any]:
        """``POST /containers``: how many nodes were unregistered, moved and adopted.

        All of it is safe to be told again. Raises BodyError, Unreachable, MasterError; the latter
        two once all has been tried.
        """
        news = requests.read_news(body)
        async with self._one_at_a_time:
            await self._parts.recovered()
            self._context.read_networks()
            failed: list[Exception] = []
            moved = await _tried(self._move(news.moved), failed)
            unregistered = await _tried(self._bury(news.gone), failed)
            adopted = await _tried(self._adopt(news.arrived), failed)
        if failed:
            raise failed[0]
        return {"unregistered": unregistered, "moved": moved, "adopted": adopted}

    async def retire(self, body: Any) -> dict[str, Any]:
        """``POST /retire``: how many nodes were unregistered; nothing is registered any more.

        Raises BodyError, Unreachable, MasterError.
        """
        requests.read_nothing(body)
        self._context.retired = True
        async with self._one_at_a_time:
            await self._parts.recovered()
            await self._none_under_way()
            endpoints = list(self._context.registry)
            count = await self._unregister(e for e in endpoints if not e.health.cleaned)
            for endpoint in endpoints:
                self._parts.cut(endpoint.port)
                self._parts.leases.end(endpoint)
        log.info("retired: %d nodes unregistered; waiting to be stopped", count)
        return {"unregistered": count}

    async def _none_under_way(self) -> None:
        end, registry = self._context.now() + RETIRE_TIMEOUT, self._context.registry
        while any(e.pending for e in registry) and self._context.now() < end:  # noqa: ASYNC110
            await asyncio.sleep(0.01)

    async def _bury(self, addresses: Sequence[str]) -> int:
        """Unregister the nodes at addresses that are gone; those that answer live on."""
        found = policy.at(self._context.registry, addresses)
        return await self._bury_all(found, self._context.now() - YOUNG)

    async def _bury_all(self, found: Sequence[Endpoint], since: float) -> int:
        """Unregister those that don't answer; who is silent and registered ``since``, later."""
        probe = self._parts.nodes.probe
        answers = await asyncio.gather(*(probe(e.slave, GONE_TIMEOUT) for e in found))
        outcomes = {e: answer.probe for e, answer in zip(found, answers, strict=True)}
        dead = policy.dead(outcomes, since)
        for endpoint in dead:
            self._close(endpoint)
        for endpoint in set(found) - set(dead):
            endpoint.health.checked = None  # another process may have the address by now
        spared = [e for e in found if e not in dead and outcomes[e] is ProbeResult.SILENT]
        if spared:
            self._context.tasks.spawn(self._bury_later(spared), "second chance of silent nodes")
        return await self._unregister(e for e in dead if not e.health.cleaned)

    async def _bury_later(self, spared: Sequence[Endpoint]) -> None:
        """Look again at silent nodes that were spared; upkeep unregisters what can't be now."""
        await asyncio.sleep(SECOND_CHANCE)
        async with self._one_at_a_time:
            there = [e for e in spared if self._context.registry.by_port.get(e.port) is e]
            await _tried(self._bury_all(there, float("inf")), [])

    def _close(self, endpoint: Endpoint) -> None:
        """Let a port refuse whose node has ended, and end what is still connected to it."""
        endpoint.health.end(self._context.now())
        self._parts.leases.close(endpoint)
        self._parts.cut(endpoint.port)
        self._context.problems.solved_at(endpoint.port)

    async def _unregister(self, endpoints: Iterable[Endpoint]) -> int:
        """Unregister nodes; how many names that were."""
        held = [endpoint for endpoint in endpoints if endpoint.registrations]
        await asyncio.gather(*(self._parts.upkeep.clean_up(endpoint) for endpoint in held))
        return sum(len(endpoint.caller_ids) for endpoint in held)

    async def _move(self, moved: Mapping[str, str]) -> int:
        """Take in that containers have other addresses now; how many nodes that concerns."""
        registry, addressing = self._context.registry, self._context.addressing
        candidates = policy.movable(registry, moved, addressing.networks)
        found = await asyncio.gather(*(self._seen(e, new) for e, new in candidates.items()))
        sights = {e: sight for e, sight in zip(candidates, found, strict=True) if sight}
        before = {endpoint: addressing.advertised_uri(endpoint) for endpoint in sights}
        places = {e: policy.new_place(e, candidates[e]) for e in sights}
        there = registry.move(places)
        for endpoint in there:
            self._settle_in(endpoint, before[endpoint], sights[endpoint])
        await self._parts.upkeep.resettle(there)
        for endpoint in set(sights) - set(there):
            await self._give_way(endpoint, places[endpoint], sights[endpoint])
        return sum(len(endpoint.caller_ids) for endpoint in there)

    async def _seen(self, endpoint: Endpoint, address: str) -> "_Sight | None":
        """The node of an endpoint if it answers at another address."""
        where = HostPort(address, endpoint.node.port)
        answer = await self._parts.nodes.probe(where)
        said = await self._parts.nodes.describe(where) if answer.pid is not None else None
        if said is None or not policy.is_same_process(endpoint, answer.pid, said.topics):
            return None
        return _Sight(answer.pid, said)

    def _settle_in(self, endpoint: Endpoint, before: str, sight: "_Sight") -> None:
        endpoint.former_uris.add(before)
        endpoint.former_uris.discard(self._context.addressing.advertised_uri(endpoint))
        endpoint.unsettled = endpoint.trusted = True
        endpoint.tcpros_port = sight.said.tcpros_port
        endpoint.health.note(ProbeResult.ANSWERED, self._context.now())
        endpoint.health.pid, endpoint.health.cleaned = sight.pid, False
        self._parts.cut(endpoint.port)
        self._context.problems.solved_at(endpoint.port)
        self._parts.leases.open(endpoint)
        log.info("%s is at %s now", endpoint.label, endpoint.place.address)

    async def _give_way(self, endpoint: Endpoint, place: Place, sight: "_Sight") -> None:
        """The node has registered from its new address already, and holds another port there."""
        there = self._context.registry.at(place.address, endpoint.node.port)
        self._close(endpoint)
        await self._parts.upkeep.clean_up(endpoint)
        if there is not None:
            await self._parts.upkeep.adopt(there, sight.said)

    async def _adopt(self, arrived: Sequence[requests.Arrival]) -> int:
        return len((await self._parts.strays.adopt(arrived)).names) if arrived else 0


@dataclass(frozen=True, slots=True)
class _Sight:
    """A node that has moved: its pid and what it says of itself."""

    pid: int | None
    said: SelfDescription


async def _tried(work: Awaitable[int], failed: list[Exception]) -> int:
    """A result; 0 if the master could not be asked, which is noted."""
    try:
        return await work
    except (Unreachable, MasterError) as error:
        failed.append(error)
        return 0
