"""Which registrations the proxy makes and takes back at the master on behalf of nodes.

The master takes a registration back only with exactly the strings that it was made with; anything
else leaves a stale entry. And it calls ``shutdown`` at the former URI of a name whose URI changes
(rosmaster/registrations.py, _register_node_api). So a name that the master has by a former URI of
the same node is freed first, of everything that it holds, and then registered anew.

The rest compares three views of a node: what the registry has, what the master has, and what the
node itself says (`NodeInfo`). A node can be asked for its topics, but not for services and
parameters.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rosproxy.net.addresses import is_loopback
from rosproxy.ros1.protocol.master_methods import MASTER_METHODS, Kind, method_spec
from rosproxy.ros1.protocol.uris import parse_slave_uri
from rosproxy.ros1.registry.endpoint import Endpoint, EndpointRegistration, Registration
from rosproxy.ros1.registry.graph import ROSOUT, TOPIC_KINDS, NodeInfo

MethodCall = tuple[str, list[Any]]
"""A method and its parameters, the caller_id first."""

COMMON_PARAMETER = "/rosout_disable_topics_generation"
"""roscpp and rospy subscribe to it with their first log message; it need not exist."""

_REGISTERING = {spec.registers: method for method, spec in MASTER_METHODS.items()}
_UNREGISTERING = {spec.unregisters: method for method, spec in MASTER_METHODS.items()}


def register_call(registration: Registration, uri: str, service: str) -> MethodCall:
    """The call that makes a registration with a slave URI, and for a service with its URI."""
    return _call(_REGISTERING[registration.kind], registration, uri, service)


def unregister_call(registration: Registration, uri: str, service: str) -> MethodCall:
    """The call that takes back a registration that was made with these URIs."""
    return _call(_UNREGISTERING[registration.kind], registration, uri, service)


def to_register(registrations: Iterable[EndpointRegistration]) -> list[EndpointRegistration]:
    """Those of some registrations that have not ended meanwhile, in the order to make them.

    Subscribers come last, so that they are handed all publishers at once.
    """
    current = [(e, r) for e, r in registrations if e.registrations.get(r.key) is r]
    return sorted(current, key=lambda pair: pair[1].kind is Kind.SUBSCRIBER)


def one_publisher_per_topic(endpoints: Iterable[Endpoint]) -> list[EndpointRegistration]:
    """One publisher of each topic that some endpoints' nodes publish.

    Registering it makes the master tell all subscribers of the topic who its publishers are.
    """
    topics: dict[str, EndpointRegistration] = {}
    for endpoint in endpoints:
        for registration in endpoint.registrations.values():
            if registration.kind is Kind.PUBLISHER and not registration.hidden:
                topics.setdefault(registration.name, (endpoint, registration))
    return list(topics.values())


def is_known_as(endpoint: Endpoint, uri: str) -> bool:
    """Whether a URI at the master is a former one of this endpoint, or its node's own.

    A loopback address does not count: it is every node's own.
    """
    is_own = parse_slave_uri(uri) == endpoint.node and not is_loopback(endpoint.node.host)
    return is_own or uri in endpoint.former_uris


def free_calls(
    registrations: Iterable[Registration], uris: Mapping[str, str], services: Mapping[str, str]
) -> list[MethodCall]:
    """The calls that end what names hold with their ``uris``; ``services`` are the services' URIs.

    Subscribers go first, so that they are not told that the publishers go.
    """
    ordered = sorted(_usable(registrations, services), key=lambda r: r.kind is not Kind.SUBSCRIBER)
    return [unregister_call(r, uris[r.caller_id], services.get(r.name, "")) for r in ordered]


def restore_calls(
    registrations: Iterable[Registration], uris: Mapping[str, str], services: Mapping[str, str]
) -> list[MethodCall]:
    """The calls that make again what `free_calls` ended."""
    usable = _usable(registrations, services)
    return [register_call(r, uris[r.caller_id], services.get(r.name, "")) for r in usable]


def release_calls(uris: Mapping[str, str], caller: str) -> list[MethodCall]:
    """The calls that end the parameter subscription that every node has, and tell what is left.

    The master shows nothing of such a subscription, apart from the name that stays known.
    """
    ask: list[MethodCall] = [("lookupNode", [caller, name]) for name in uris]
    params = [Registration(Kind.PARAM, COMMON_PARAMETER, name) for name in uris]
    return [*ask, *free_calls(params, uris, {}), *ask]


def read_release(
    uris: Mapping[str, str], values: Sequence[Any]
) -> tuple[list[Registration], dict[str, str]]:
    """The results of `release_calls`: subscriptions that ended; names known still, with URIs."""
    # First where each name was, then whether its subscription has ended, then where it is now.
    before = zip(uris, values, strict=False)
    after = zip(uris, values[2 * len(uris) :], strict=True)
    known_uris = {name: uri for name, uri in after if uri is not None}
    ended = [name for name, uri in before if uri is not None and name not in known_uris]
    return [Registration(Kind.PARAM, COMMON_PARAMETER, name) for name in ended], known_uris


def left_over_registrations(
    endpoint: Endpoint, info: NodeInfo, before: float
) -> list[Registration]:
    """Which of an endpoint's registrations a process that is gone has left behind.

    A topic is left behind if the node says that it does not have it; all of a node name is, if
    another name has registered since and none of its own topics, apart from the /rosout of nearly
    every node, may hold. Registrations made after ``before`` are not.
    """
    registrations = list(endpoint.registrations.values())
    newest = max(registrations, key=lambda r: r.since, default=None)

    def may_hold(registration: Registration) -> bool:
        is_conclusive = registration.kind in TOPIC_KINDS and registration.name != ROSOUT
        return is_conclusive and info.holds(registration) is not False

    live_names = {r.caller_id for r in registrations if r is newest or may_hold(r)}
    gone = vanished_topics(endpoint, info, before)
    return [
        r
        for r in registrations
        if r in gone or (r.since < before and r.caller_id not in live_names)
    ]


def vanished_topics(endpoint: Endpoint, info: NodeInfo, before: float) -> list[Registration]:
    """The topics registered before a time that the node says it does not have.

    A node that registers around the proxy unregisters there too, where its URI means nothing.
    """
    registrations = endpoint.registrations.values()
    return [r for r in registrations if info.holds(r) is False and r.since < before]


def valid_registrations(
    endpoint: Endpoint, info: NodeInfo, same_process: bool
) -> list[Registration]:
    """Which of an endpoint's registrations hold for a node that has come back.

    A topic does unless the node says that it does not have it; services and parameters, which it
    can't be asked for, if it is the ``same_process`` and not all of its topics have gone.
    """
    registrations = list(endpoint.registrations.values())
    topics = [r for r in registrations if r.kind in TOPIC_KINDS]
    kept = [r for r in topics if info.holds(r) is not False]
    if not same_process or (topics and not kept):
        return kept
    return kept + [r for r in registrations if r.kind not in TOPIC_KINDS]


def unregistered_topics(endpoint: Endpoint, info: NodeInfo) -> list[Registration]:
    """The topics that a node has, with their types, and the master does not know of.

    rospy gives up a registration for which it found no master. Of a slave API that several
    node names share nothing is listed.
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
    ours: Sequence[Registration], state: Mapping[str, list[Registration]], before: float
) -> list[Registration]:
    """Which of our registrations the master no longer has.

    Those made after ``before``, the time at which the master was asked, don't count; nor do
    parameter subscriptions, which the master's state leaves out, unless their node is unknown.
    """
    ours = [r for r in ours if not r.hidden]
    keys = {r.key for of_node in state.values() for r in of_node}
    params = [r for r in ours if r.kind is Kind.PARAM]
    gone = [r for r in ours if r.since < before and r.key not in keys and r.kind is not Kind.PARAM]
    lost_nodes = {r.caller_id for r in gone} - set(state)
    return gone + [r for r in params if r.caller_id in lost_nodes]


def _usable(
    registrations: Iterable[Registration], services: Mapping[str, str]
) -> list[Registration]:
    """Those of some registrations that are no services, or services with a known URI."""
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
    # What a method does not have is under None, which is left out.
    return method, [params[position] for position in range(4) if position in params]
