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

_REGISTERING = {found.registers: method for method, found in MASTER_METHODS.items()}
_UNREGISTERING = {found.unregisters: method for method, found in MASTER_METHODS.items()}


def register_call(held: Registration, uri: str, service: str) -> MethodCall:
    """The call that makes a registration with a slave URI, and for a service with its URI."""
    return _call(_REGISTERING[held.kind], held, uri, service)


def unregister_call(held: Registration, uri: str, service: str) -> MethodCall:
    """The call that takes back a registration that was made with these URIs."""
    return _call(_UNREGISTERING[held.kind], held, uri, service)


def to_register(held: Iterable[EndpointRegistration]) -> list[EndpointRegistration]:
    """Those of some registrations that have not ended meanwhile, in the order to make them.

    Subscribers come last, so that they are handed all publishers at once.
    """
    current = [(e, one) for e, one in held if e.registrations.get(one.key) is one]
    return sorted(current, key=lambda item: item[1].kind is Kind.SUBSCRIBER)


def one_publisher_per_topic(endpoints: Iterable[Endpoint]) -> list[EndpointRegistration]:
    """One publisher of each topic that some endpoints' nodes publish.

    Registering it makes the master tell all subscribers of the topic who its publishers are.
    """
    topics: dict[str, EndpointRegistration] = {}
    for endpoint in endpoints:
        for held in endpoint.registrations.values():
            if held.kind is Kind.PUBLISHER and not held.hidden:
                topics.setdefault(held.name, (endpoint, held))
    return list(topics.values())


def known_as(endpoint: Endpoint, uri: str) -> bool:
    """Whether a URI at the master is a former one of this endpoint, or its node's own.

    A loopback address is everybody's own.
    """
    own = parse_slave_uri(uri) == endpoint.node and not is_loopback(endpoint.node.host)
    return own or uri in endpoint.former_uris


def free_calls(
    held: Iterable[Registration], uris: Mapping[str, str], services: Mapping[str, str]
) -> list[MethodCall]:
    """The calls that end what names hold with their ``uris``; ``services`` are the services' URIs.

    Subscribers go first, so that they are not told that the publishers go.
    """
    known = sorted(_known(held, services), key=lambda one: one.kind is not Kind.SUBSCRIBER)
    return [unregister_call(one, uris[one.caller_id], services.get(one.name, "")) for one in known]


def restore_calls(
    held: Iterable[Registration], uris: Mapping[str, str], services: Mapping[str, str]
) -> list[MethodCall]:
    """The calls that make again what `free_calls` ended."""
    known = _known(held, services)
    return [register_call(one, uris[one.caller_id], services.get(one.name, "")) for one in known]


def release_calls(uris: Mapping[str, str], caller: str) -> list[MethodCall]:
    """The calls that end the parameter subscription that every node has, and tell what is left.

    There is nothing to see of such a subscription, apart from the name that stays known.
    """
    ask: list[MethodCall] = [("lookupNode", [caller, name]) for name in uris]
    params = [Registration(Kind.PARAM, COMMON_PARAMETER, name) for name in uris]
    return [*ask, *free_calls(params, uris, {}), *ask]


def read_release(
    uris: Mapping[str, str], values: Sequence[Any]
) -> tuple[list[Registration], dict[str, str]]:
    """The results of `release_calls`: subscriptions that ended; names known still, with URIs."""
    before = zip(uris, values, strict=False)
    after = zip(uris, values[2 * len(uris) :], strict=True)
    known = {name: uri for name, uri in after if uri is not None}
    held = [name for name, uri in before if uri is not None and name not in known]
    return [Registration(Kind.PARAM, COMMON_PARAMETER, name) for name in held], known


def left_over(endpoint: Endpoint, info: NodeInfo, before: float) -> list[Registration]:
    """Which of an endpoint's registrations a process that is gone has left behind.

    A topic is, if the node says that it does not have it; a whole node name is, if another has
    registered since and none of its topics, apart from everybody's /rosout, may hold.
    Registrations made after ``before`` are not.
    """
    everything = list(endpoint.registrations.values())
    newest = max(everything, key=lambda held: held.since, default=None)

    def may_hold(held: Registration) -> bool:
        telling = held.kind in TOPIC_KINDS and held.name != ROSOUT
        return telling and info.holds(held) is not False

    alive = {held.caller_id for held in everything if held is newest or may_hold(held)}
    gone = vanished(endpoint, info, before)
    return [
        held
        for held in everything
        if held in gone or (held.since < before and held.caller_id not in alive)
    ]


def vanished(endpoint: Endpoint, info: NodeInfo, before: float) -> list[Registration]:
    """The topics registered before a time that the node says it does not have.

    A node that registers around the proxy unregisters there too, where its URI means nothing.
    """
    everything = endpoint.registrations.values()
    return [held for held in everything if info.holds(held) is False and held.since < before]


def still_held(endpoint: Endpoint, info: NodeInfo, same_process: bool) -> list[Registration]:
    """Which of an endpoint's registrations hold for a node that has come back.

    A topic does unless the node says that it does not have it; services and parameters, which it
    can't be asked for, if it is the ``same_process`` and not all of its topics have gone.
    """
    everything = list(endpoint.registrations.values())
    topics = [held for held in everything if held.kind in TOPIC_KINDS]
    kept = [held for held in topics if info.holds(held) is not False]
    if not same_process or (topics and not kept):
        return kept
    return kept + [held for held in everything if held.kind not in TOPIC_KINDS]


def unregistered(endpoint: Endpoint, info: NodeInfo) -> list[Registration]:
    """The topics that a node has, with their types, and the master does not know of.

    rospy gives up a registration for which it found no master. Nothing is said of a slave API
    that several node names share.
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


def lost(
    ours: Sequence[Registration], state: Mapping[str, list[Registration]], before: float
) -> list[Registration]:
    """Which of our registrations the master no longer has.

    Those made after ``before``, the time at which the master was asked, don't count; nor do
    parameter subscriptions, which the master's state leaves out, unless their node is unknown.
    """
    ours = [held for held in ours if not held.hidden]
    known = {held.key for registrations in state.values() for held in registrations}
    params = [held for held in ours if held.kind is Kind.PARAM]
    gone = [h for h in ours if h.since < before and h.key not in known and h.kind is not Kind.PARAM]
    lost_nodes = {held.caller_id for held in gone} - set(state)
    return gone + [held for held in params if held.caller_id in lost_nodes]


def _known(held: Iterable[Registration], services: Mapping[str, str]) -> list[Registration]:
    """Those of some registrations that are no services whose URI is not known (any more)."""
    return [one for one in held if one.kind is not Kind.SERVICE or one.name in services]


def _call(method: str, held: Registration, uri: str, service: str) -> MethodCall:
    places = method_spec(method)
    params = {
        0: held.caller_id,
        places.name: held.name,
        places.type: held.type,
        places.service_api: service,
        places.caller_api: uri,
    }
    return method, [params[place] for place in range(4) if place in params]
