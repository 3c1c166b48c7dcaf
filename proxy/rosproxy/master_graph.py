"""Reading the ROS graph from the master."""

import asyncio
from collections.abc import Iterable, Mapping, Sequence

from rosproxy.core.graph import Graph, GraphError, read_state
from rosproxy.core.registry import Registration
from rosproxy.upstream import CALLER_ID, MasterError, Upstream


async def read_registrations(upstream: Upstream) -> dict[str, list[Registration]]:
    """What each node has registered. Raises Unreachable, MasterError."""
    state, types = await asyncio.gather(
        upstream.ask_master("getSystemState"), upstream.ask_master("getTopicTypes")
    )
    try:
        return read_state(state, types)
    except GraphError as error:
        raise MasterError(str(error)) from None


async def read_graph(upstream: Upstream) -> Graph:
    """What each node has registered, and where it is. Raises Unreachable, MasterError."""
    held = await read_registrations(upstream)
    return await locate(upstream, held, held)


async def locate(
    upstream: Upstream, held: Mapping[str, Sequence[Registration]], nodes: Iterable[str]
) -> Graph:
    """What nodes have registered, with where some of them are. Raises Unreachable."""
    names = sorted(nodes)
    uris = await upstream.batch([("lookupNode", [CALLER_ID, name]) for name in names])
    found = zip(names, uris, strict=False)
    return Graph(held, {name: uri for name, uri in found if isinstance(uri, str)})
