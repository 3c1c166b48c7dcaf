"""Which registrations the proxy makes and takes back at the master on behalf of nodes.

The master takes a registration back only if the call has exactly the strings of the registration.
With other strings, a stale entry stays. When the URI of a name changes, the master calls
``shutdown`` at the former URI (rosmaster/registrations.py, _register_node_api). So if the master
has a name by a former URI of the same node, the proxy first takes back all registrations of the
name, and then registers the name again.

The other functions compare three views of a node: the registry, the master, and what the node
itself says (`NodeInfo`). A node names its topics, but not its services and parameters.
"""

from collections.abc import Iterable, Mapping, Sequence
from itertools import islice
from typing import Any

from rosproxy.ros1.protocol.master_methods import MASTER_METHODS, Kind, method_spec
from rosproxy.ros1.registry.endpoint import (
    MOST_CALLERS,
    Endpoint,
    EndpointRegistration,
    Registration,
)
from rosproxy.ros1.registry.graph import ROSOUT, TOPIC_KINDS, NodeInfo
from rosproxy.shared.addresses import is_loopback
from rosproxy.shared.uris import parse_slave_uri

MethodCall = tuple[str, list[Any]]
"""A method and its parameters, the caller_id first."""

COMMON_PARAMETER = "/rosout_disable_topics_generation"
"""roscpp and rospy subscribe to this parameter with their first log message, set or not."""

_REGISTERING = {spec.registers: method for method, spec in MASTER_METHODS.items()}
_UNREGISTERING = {spec.unregisters: method for method, spec in MASTER_METHODS.items()}


def register_call(registration: Registration, uri: str, service: str) -> MethodCall:
    """The call that makes a registration with a slave URI and, for a service, a service URI."""
    return _call(_REGISTERING[registration.kind], registration, uri, service)


def unregister_call(registration: Registration, uri: str, service: str) -> MethodCall:
    """The call that takes back a registration that was made with these URIs."""
    return _call(_UNREGISTERING[registration.kind], registration, uri, service)


def to_register(registrations: Iterable[EndpointRegistration]) -> list[EndpointRegistration]:
    """The registrations that have not ended meanwhile, in the order in which to make them.

    Subscribers come last, so that each subscriber gets all publishers at once.
    """
    current = [(e, r) for e, r in registrations if e.registrations.get(r.key) is r]
    return sorted(current, key=lambda pair: pair[1].kind is Kind.SUBSCRIBER)


def one_publisher_per_topic(endpoints: Iterable[Endpoint]) -> list[EndpointRegistration]:
    """A single publisher of each topic that the nodes of some endpoints publish.

    When the proxy registers this publisher, the master sends all subscribers of the topic the list
    of publishers.
    """
    topics: dict[str, EndpointRegistration] = {}
    for endpoint in endpoints:
        for registration in endpoint.registrations.values():
            if registration.kind is Kind.PUBLISHER and not registration.hidden:
                topics.setdefault(registration.name, (endpoint, registration))
    return list(topics.values())


def is_known_as(endpoint: Endpoint, uri: str) -> bool:
    """Whether a URI at the master is a former URI of this endpoint, or the node's own URI.

    A loopback address does not count, because every node may give a loopback address.
    """
    is_own = parse_slave_uri(uri) == endpoint.node and not is_loopback(endpoint.node.host)
    return is_own or uri in endpoint.former_uris


def free_calls(
    registrations: Iterable[Registration], uris: Mapping[str, str], services: Mapping[str, str]
) -> list[MethodCall]:
    """The calls that end all registrations of some names.

    ``uris`` has the slave URI of each name, ``services`` the URI of each service. Subscribers go
    first, so that the master does not tell subscribers that publishers have gone.
    """
    ordered = sorted(_usable(registrations, services), key=lambda r: r.kind is not Kind.SUBSCRIBER)
    return [unregister_call(r, uris[r.caller_id], services.get(r.name, "")) for r in ordered]


def restore_calls(
    registrations: Iterable[Registration], uris: Mapping[str, str], services: Mapping[str, str]
) -> list[MethodCall]:
    """The calls that make again the registrations that `free_calls` ended."""
    usable = _usable(registrations, services)
    return [register_call(r, uris[r.caller_id], services.get(r.name, "")) for r in usable]


def release_calls(uris: Mapping[str, str], caller: str) -> list[MethodCall]:
    """The calls that end each node's subscription to COMMON_PARAMETER.

    The master does not list such a subscription, but knows the name of the node as long as the
    subscription lasts. So lookupNode asks for each name before and after. ``caller`` makes these
    calls.
    """
    ask: list[MethodCall] = [("lookupNode", [caller, name]) for name in uris]
    params = [Registration(Kind.PARAM, COMMON_PARAMETER, name) for name in uris]
    return [*ask, *free_calls(params, uris, {}), *ask]


def read_release(
    uris: Mapping[str, str], values: Sequence[Any]
) -> tuple[list[Registration], dict[str, str]]:
    """Read the results of `release_calls`.

    Returns:
        The subscriptions that have ended, and the URIs of the names that the master still knows.
    """
    # The results: first where each name was, then the unsubscriptions, then where each name is.
    before = zip(uris, values, strict=False)
    after = zip(uris, values[2 * len(uris) :], strict=True)
    known_uris = {name: uri for name, uri in after if uri is not None}
    ended = [name for name, uri in before if uri is not None and name not in known_uris]
    return [Registration(Kind.PARAM, COMMON_PARAMETER, name) for name in ended], known_uris


def left_over_registrations(
    endpoint: Endpoint, info: NodeInfo, before: float
) -> list[Registration]:
    """The registrations of an endpoint that an ended process has left behind.

    - A topic is left over if the node says that it does not have the topic.
    - All registrations of a node name are left over under two conditions. Another name has
      registered since. And the node names no topic of the first name, apart from /rosout, which
      nearly every node has.
    - All registrations of the oldest name are left over if the endpoint has MOST_CALLERS names. A
      node that takes another name with each start, at the same port, has the same topics each time.

    Registrations made after ``before`` are never left over.
    """
    registrations = list(endpoint.registrations.values())
    newest = max(registrations, key=lambda r: r.since, default=None)

    def may_hold(registration: Registration) -> bool:
        is_conclusive = registration.kind in TOPIC_KINDS and registration.name != ROSOUT
        return is_conclusive and info.holds(registration) is not False

    live_names = {r.caller_id for r in registrations if r is newest or may_hold(r)}
    by_age = sorted(registrations, key=lambda r: r.since, reverse=True)
    newest_names = dict.fromkeys(r.caller_id for r in by_age if r.caller_id in live_names)
    live_names = set(islice(newest_names, MOST_CALLERS - 1))
    gone = vanished_topics(endpoint, info, before)
    return [
        r
        for r in registrations
        if r in gone or (r.since < before and r.caller_id not in live_names)
    ]


def vanished_topics(endpoint: Endpoint, info: NodeInfo, before: float) -> list[Registration]:
    """The topics, registered before the time ``before``, that the node says it does not have.

    A node that registers at the real master directly also unregisters there. The master ignores
    such a call, because the master has another URI for the node.
    """
    registrations = endpoint.registrations.values()
    return [r for r in registrations if info.holds(r) is False and r.since < before]


def valid_registrations(
    endpoint: Endpoint, info: NodeInfo, same_process: bool
) -> list[Registration]:
    """The registrations of an endpoint that hold for a node that has come back.

    A topic holds unless the node says that it does not have the topic. Services and parameters
    cannot be asked for. Both hold if the ``same_process`` answers, and has not lost all topics.
    """
    registrations = list(endpoint.registrations.values())
    topics = [r for r in registrations if r.kind in TOPIC_KINDS]
    kept = [r for r in topics if info.holds(r) is not False]
    if not same_process or (topics and not kept):
        return kept
    return kept + [r for r in registrations if r.kind not in TOPIC_KINDS]


def unregistered_topics(endpoint: Endpoint, info: NodeInfo) -> list[Registration]:
    """The topics that a node has and that are not registered through the proxy, with their types.

    rospy gives up a registration without a master. If several node names share the slave API, the
    list is empty.
    """
    names = endpoint.caller_ids
    if len(names) != 1:
        return []
    return [
        Registration(kind, topic, names[0], type_)
        for kind, topics in info.by_kind.items()
        for topic, type_ in topics.items()
        if (kind, topic, names[0]) not in endpoint.registrations
    ]


def lost_registrations(
    recorded: Sequence[Registration], state: Mapping[str, list[Registration]], before: float
) -> list[Registration]:
    """The registrations of an endpoint (``recorded``) that the master no longer has.

    ``before`` is the time at which the master was asked: later registrations do not count. The
    state of the master has no parameter subscriptions. These count as lost if the master has lost
    the whole node.
    """
    recorded = [r for r in recorded if not r.hidden]
    names = {r.caller_id for r in recorded}
    keys = {r.key for name in names for r in state.get(name, ())}
    params = [r for r in recorded if r.kind is Kind.PARAM]
    gone = [
        r for r in recorded if r.since < before and r.key not in keys and r.kind is not Kind.PARAM
    ]
    lost_nodes = {r.caller_id for r in gone} - set(state)
    return gone + [r for r in params if r.caller_id in lost_nodes]


def _usable(
    registrations: Iterable[Registration], services: Mapping[str, str]
) -> list[Registration]:
    """The registrations without the services whose URI is unknown."""
    return [r for r in registrations if r.kind is not Kind.SERVICE or r.name in services]


def _call(method: str, registration: Registration, uri: str, service: str) -> MethodCall:
    positions = method_spec(method)
    params = {
        0: registration.caller_id,
        positions.name: registration.name,
        positions.type: registration.type,
        positions.service_api: service,
        positions.caller_api: uri,
    }
    # Parameters that the method does not have are under the key None, and left out.
    return method, [params[position] for position in range(4) if position in params]
