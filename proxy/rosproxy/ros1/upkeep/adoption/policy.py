"""Nodes that registered around the proxy, and how the master is made to know them through it.

A container may start while its master's name still leads to the real master. Its nodes then
register with their own URIs, which outside can't reach. To register such a node anew in the
leased form would end it: the master calls ``shutdown`` at the former URI of a name whose URI
changes (rosmaster/registrations.py, _register_node_api). So everything that the name holds is
taken back first, with the strings that were registered.

Its connection to the real master stays open (both client libraries keep it), so that later calls
of such a node may go around the proxy as well.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

from rosproxy.admin.requests import Arrival
from rosproxy.net.addresses import HostPort, is_loopback
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.protocol.uris import parse_slave_uri
from rosproxy.ros1.registry.endpoint import Endpoint, Registration
from rosproxy.ros1.registry.graph import Graph
from rosproxy.ros1.rewriting.addressing import Addressing
from rosproxy.ros1.upkeep.policy import MethodCall, registering, unregistering

EVERYBODYS_PARAMETERS = ("/rosout_disable_topics_generation",)
"""roscpp and rospy subscribe to it with their first log message; it need not exist."""
_REASON = re.compile(r"\[(/[^\]\s]*)\] Reason: new node registered")
"""rosmaster/registrations.py, shutdown_node_task."""
_ORDER = (Kind.SUBSCRIBER, Kind.PUBLISHER, Kind.SERVICE, Kind.PARAM)
"""Subscribers go first, so that they are not told that the publishers go."""


@dataclass(frozen=True, slots=True)
class Stray:
    """A node that is registered with its own URI, and the places where it may be."""

    caller_id: str
    uri: str
    places: tuple[HostPort, ...]
    registrations: tuple[Registration, ...]

    @property
    def topics(self) -> set[str]:
        """Its topics, without everybody's /rosout as far as it has others."""
        names = {held.name for held in self.registrations if held.kind is not Kind.SERVICE}
        return names - {"/rosout"} or names


def find(graph: Graph, arrived: Iterable[Arrival], addressing: Addressing) -> list[Stray]:
    """The nodes of a master whose URI may mean one of the containers that have arrived."""
    found, containers = [], list(arrived)
    for name, uri in graph.uris.items():
        where = parse_slave_uri(uri)
        if where is None or addressing.advertises(where):
            continue
        called = dict.fromkeys(c.address for c in containers if c.is_called(where.host))
        if called:
            places = tuple(HostPort(address, where.port) for address in called)
            found.append(Stray(name, uri, places, tuple(graph.held.get(name, ()))))
    return found


def settle(
    strays: Iterable[Stray], topics: Mapping[HostPort, Iterable[str]]
) -> tuple[dict[HostPort, list[Stray]], dict[str, str]]:
    """Where each stray is, and why some are left alone, by name.

    ``topics`` are those that the node at a place names itself; places without a node are missing.
    """
    found: dict[HostPort, list[Stray]] = {}
    doubts: dict[str, str] = {}
    for stray in strays:
        merits = {p: _merit(stray, set(topics[p])) for p in stray.places if p in topics}
        borne_out = {place: merit for place, merit in merits.items() if merit is not None}
        best = [p for p, merit in borne_out.items() if merit == max(borne_out.values())]
        if len(best) == 1:
            found.setdefault(best[0], []).append(stray)
        else:
            doubts[stray.caller_id] = _doubt(stray, best, topics)
    return found, doubts


def known_as(endpoint: Endpoint, uri: str) -> bool:
    """Whether a URI at the master is a former one of this endpoint, or its node's own.

    A loopback address is everybody's own.
    """
    own = uri == endpoint.uri and not is_loopback(endpoint.node.host)
    return own or uri in endpoint.former_uris


class Verdict(Enum):
    """What a ``shutdown`` that the master sends to a node is about."""

    GUILTY = "another node has its name"
    ASTRAY = "it registered around the proxy"
    SETTLED = "it did, and is registered anew already"


def accused(caller_id: str, reason: str) -> str | None:
    """The name whose URI has changed, if that is why the master calls ``shutdown``."""
    found = _REASON.match(reason)
    return found[1] if found and caller_id == "/master" else None


def judge(endpoint: Endpoint, uri: str | None, advertised: str) -> Verdict:
    """Whether a name of an endpoint, which the master has by a URI now, is to be shut down."""
    if uri == advertised:
        return Verdict.SETTLED
    if uri is None:
        return Verdict.ASTRAY if endpoint.direct else Verdict.GUILTY
    return Verdict.ASTRAY if known_as(endpoint, uri) else Verdict.GUILTY


def own_keys(caller_id: str, parameters: Iterable[str]) -> list[str]:
    """The parameters that a node is most likely subscribed to; the master does not tell.

    The period is diagnostic_updater's; it need not exist.
    """
    own = [key for key in _with_namespaces(parameters) if f"{key}/".startswith(f"{caller_id}/")]
    return list(dict.fromkeys([*EVERYBODYS_PARAMETERS, f"{caller_id}/diagnostic_period", *own]))


def other_keys(caller_id: str, parameters: Sequence[str]) -> list[str]:
    """All other parameters and namespaces that a node can be subscribed to."""
    known = set(own_keys(caller_id, parameters))
    return [key for key in ["/", *_with_namespaces(parameters)] if key not in known]


def take_back(
    uris: Mapping[str, str],
    held: Mapping[str, Sequence[Registration]],
    services: Mapping[str, str | None],
) -> list[MethodCall]:
    """The calls that end what names hold with their ``uris``; ``services`` are the services' URIs.

    The master takes the strings only exactly as they were registered.
    """
    wanted = [one for name in uris for one in held.get(name, ())]
    wanted.sort(key=lambda one: _ORDER.index(one.kind))
    return [
        unregistering(one, uris[one.caller_id], services.get(one.name) or "")
        for one in wanted
        if one.kind is not Kind.SERVICE or services.get(one.name)
    ]


def put_back(
    uri: str, held: Iterable[Registration], services: Mapping[str, str | None]
) -> list[MethodCall]:
    """The calls that make registrations with ``uri`` again."""
    return [
        registering(one, uri, services.get(one.name) or "")
        for one in held
        if one.kind is not Kind.SERVICE or services.get(one.name)
    ]


def release(caller_id: str, uri: str, keys: Iterable[str], asker: str) -> list[MethodCall]:
    """Calls that end one parameter subscription after the other, and ask each time what is left.

    There is nothing to see of such a subscription, apart from the name that stays known.
    """
    ask: MethodCall = ("lookupNode", [asker, caller_id])
    calls = [ask]
    for key in keys:
        calls += [("unsubscribeParam", [caller_id, uri, key]), ask]
    return calls


def released(keys: Sequence[str], values: Sequence[object]) -> list[str] | None:
    """The parameters that the name was subscribed to at most, from the results of `release`.

    None if it is known still. The last one is sure; those before it may have been.
    """
    gone = next((i for i, value in enumerate(values[::2]) if value is None), None)
    return None if gone is None else list(keys[:gone])


def vanished(
    endpoint: Endpoint, published: Iterable[str], subscribed: Iterable[str], before: float
) -> list[Registration]:
    """The topics registered before a time that the node no longer has.

    It may have unregistered them around the proxy, where its own URI meant nothing.
    """
    topics = {Kind.PUBLISHER: set(published), Kind.SUBSCRIBER: set(subscribed)}
    return [
        held
        for held in endpoint.registrations.values()
        if held.kind in topics and held.name not in topics[held.kind] and held.since < before
    ]


def _merit(stray: Stray, topics: set[str]) -> int | None:
    """How well a node's own topics bear out that it is the stray; None if not at all."""
    shared = stray.topics & topics
    return len(shared) - len(stray.topics - topics) if shared else None


def _doubt(stray: Stray, best: list[HostPort], topics: Mapping[HostPort, Iterable[str]]) -> str:
    places = ", ".join(str(place) for place in stray.places)
    if best:
        either = " and ".join(str(place) for place in best)
        return f"registered as {stray.uri} around the proxy: could be at {either}; left alone"
    if any(place in topics for place in stray.places):
        return f"registered as {stray.uri} around the proxy: the node at {places} is another"
    return f"registered as {stray.uri} around the proxy: no node answers at {places}"


def _with_namespaces(parameters: Iterable[str]) -> Iterator[str]:
    seen: set[str] = set()
    for name in parameters:
        parts = name.strip("/").split("/")
        for count in range(len(parts), 0, -1):
            key = "/" + "/".join(parts[:count])
            if key not in seen:
                seen.add(key)
                yield key
