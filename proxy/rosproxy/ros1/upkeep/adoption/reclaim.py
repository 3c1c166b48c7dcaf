"""Taking back at the master what nodes registered around the proxy (see `core.strays`)."""

import asyncio
import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from rosproxy.ros1.clients.master import CALLER_ID, MasterError
from rosproxy.ros1.clients.master_graph import read_registrations
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import Registration
from rosproxy.ros1.upkeep.adoption import policy
from rosproxy.ros1.upkeep.policy import MethodCall

log = logging.getLogger(__name__)

Uris = Mapping[str, str]
"""Names of nodes with the URIs that the master has for them."""


@dataclass(frozen=True, slots=True)
class _Known:
    """What the master says of all names: registrations, services' URIs, parameters."""

    held: Mapping[str, list[Registration]]
    services: Mapping[str, str | None]
    parameters: list[str]


class Reclaim:
    """Takes registrations back with the strings that they were made with."""

    def __init__(self, context: Context) -> None:
        self._context = context

    async def take_back(self, uris: Uris) -> tuple[dict[str, list[Registration]], set[str]]:
        """End everything that some names hold.

        What that was, of the names that are free now; and the names that are not, because of a
        parameter subscription that can't be found: they get back what they had. Neither has a
        name that was registered otherwise meanwhile. Raises Unreachable, MasterError.
        """
        known = await self._look(uris)
        keys = {name: policy.own_keys(name, known.parameters) for name in uris}
        first = policy.take_back(uris, known.held, known.services)
        freed = await self._release(uris, keys, first)
        left = {name: uri for name, uri in uris.items() if name not in freed}
        stuck: set[str] = set()
        if left:
            keys = {name: policy.other_keys(name, known.parameters) for name in left}
            freed |= await self._release(left, keys)
            stuck = await self._put_back({n: u for n, u in left.items() if n not in freed}, known)
        had = {name: [*known.held.get(name, []), *params] for name, params in freed.items()}
        return had, stuck

    async def _look(self, uris: Uris) -> _Known:
        held, parameters = await asyncio.gather(
            read_registrations(self._context.upstream), self._parameters()
        )
        mine = [one for name in uris for one in held.get(name, [])]
        services = [one.name for one in mine if one.kind is Kind.SERVICE]
        found = await self._context.upstream.batch(
            [("lookupService", [CALLER_ID, service]) for service in services]
        )
        return _Known(held, dict(zip(services, found, strict=True)), parameters)

    async def _parameters(self) -> list[str]:
        try:
            names = await self._context.upstream.ask_master("getParamNames")
        except MasterError:
            return []
        return [name for name in names if isinstance(name, str)] if isinstance(names, list) else []

    async def _release(
        self, uris: Uris, keys: Mapping[str, list[str]], first: Iterable[MethodCall] = ()
    ) -> dict[str, list[Registration]]:
        """After ``first``, end parameter subscriptions; those of the names that are free then."""
        calls, parts = list(first), []
        for name, uri in uris.items():
            part = policy.release(name, uri, keys[name], CALLER_ID)
            parts.append((name, len(calls), len(calls) + len(part)))
            calls += part
        values = await self._context.upstream.batch(calls)
        found = {name: policy.released(keys[name], values[start:end]) for name, start, end in parts}
        return {
            name: [Registration(Kind.PARAM, key, name) for key in had]
            for name, had in found.items()
            if had is not None
        }

    async def _put_back(self, uris: Uris, known: _Known) -> set[str]:
        """Make registrations again as they were, of the names that are known as they were."""
        now = await self._context.upstream.batch(
            [("lookupNode", [CALLER_ID, name]) for name in uris]
        )
        still = {name: uri for (name, uri), at in zip(uris.items(), now, strict=True) if at == uri}
        calls = [
            call
            for name, uri in still.items()
            for call in policy.put_back(uri, known.held.get(name, []), known.services)
        ]
        await self._context.upstream.batch(calls)
        for name, uri in still.items():
            text = (
                f"registered as {uri} around the proxy and can't be taken over: it is subscribed "
                "to a parameter that doesn't exist. Restart its container"
            )
            log.warning("%s: %s", name, text)
            self._context.problems.add(name, text)
        return set(still)
