"""Reading the ROS graph from the master."""

import asyncio
from collections.abc import Iterable

import msgspec

from rosproxy.ros1.clients.master import CALLER_ID, MasterClient, MasterError
from rosproxy.ros1.registry.endpoint import Registration
from rosproxy.ros1.registry.graph import Graph, read_state


async def read_registrations(upstream: MasterClient) -> dict[str, list[Registration]]:
    """What each node has registered. Raises Unreachable, MasterError."""
    state, types = await asyncio.gather(
        upstream.call_master("getSystemState"), upstream.call_master("getTopicTypes")
    )
    try:
        return read_state(state, types)
    except msgspec.ValidationError as error:
        raise MasterError(f"getSystemState: {error}") from None


async def read_graph(upstream: MasterClient) -> Graph:
    """What each node has registered, and where it is. Raises Unreachable, MasterError."""
    held = await read_registrations(upstream)
    return Graph(held, await look_up_nodes(upstream, held))


async def look_up_nodes(upstream: MasterClient, nodes: Iterable[str]) -> dict[str, str]:
    """The slave URIs of those nodes that the master knows. Raises Unreachable."""
    return await _look_up(upstream, "lookupNode", nodes)


async def look_up_services(upstream: MasterClient, services: Iterable[str]) -> dict[str, str]:
    """The URIs of those services that the master knows. Raises Unreachable."""
    return await _look_up(upstream, "lookupService", services)


async def _look_up(upstream: MasterClient, method: str, names: Iterable[str]) -> dict[str, str]:
    wanted = sorted(names)
    uris = await upstream.multicall([(method, [CALLER_ID, name]) for name in wanted])
    found = zip(wanted, uris, strict=True)
    return {name: uri for name, uri in found if isinstance(uri, str)}
