"""The policy's part in calls: what of a call is asked about, and what is answered in its place.

A registration that is denied is answered as the master would have answered it, with what the nodes
inside are to know; `rosproxy.ros1.registry.hidden_registrations` tells what that is. Texts and
values of replies: ros_comm/tools/rosmaster/src/rosmaster/master_api.py and registrations.py, and
for a topic that a node does not publish clients/rospy/src/rospy/impl/masterslave.py (requestTopic).
"""

from collections.abc import Iterable, Sequence

import msgspec
from msgspec.structs import replace

from rosproxy.access.rules import RuleKind
from rosproxy.ros1.protocol.master_methods import Kind, resolve_name
from rosproxy.ros1.protocol.xmlrpc.document import Call
from rosproxy.ros1.registry import hidden_registrations
from rosproxy.ros1.registry.endpoint import Endpoint, Registration
from rosproxy.ros1.rewriting.addressing import Addressing, Caller
from rosproxy.ros1.rewriting.master_calls import LocalAnswer, RegistryChange, second_parameter_name

KINDS = {
    Kind.PUBLISHER: RuleKind.PUBLISH,
    Kind.SUBSCRIBER: RuleKind.SUBSCRIBE,
    Kind.SERVICE: RuleKind.SERVE,
    Kind.PARAM: RuleKind.GET_PARAM,
}
"""Which rules a registration is asked about."""
_EVERYTHING = "/"
_READS = {"getParam": 1, "hasParam": 1, "searchParam": 1, "subscribeParam": 2}
_WRITES = {"setParam": 1, "deleteParam": 1}
_WHOLE = frozenset({"getParam", "subscribeParam", "setParam", "deleteParam"})
"""Those that are about a whole namespace, if the name is one."""


class ParamUse(msgspec.Struct, frozen=True):
    """What a call does with parameters: the names that it may mean, and whether all below them."""

    kind: RuleKind
    names: tuple[str, ...]
    below: bool


def param_use(method: str, caller_id: str, name: str | None) -> ParamUse | None:
    """What a call does with parameters; None if nothing. ``name`` is None if it can't be told."""
    kind = RuleKind.SET_PARAM if method in _WRITES else RuleKind.GET_PARAM
    if method not in _READS and method not in _WRITES:
        return None
    if name is None:
        return ParamUse(kind, (_EVERYTHING,), True)
    if method == "searchParam":
        return ParamUse(kind, _searched_names(caller_id, name), False)
    return ParamUse(kind, (resolve_name(name, caller_id),), method in _WHOLE)


def param_use_of(call: Call) -> ParamUse | None:
    """What a call that was read does with parameters; None if nothing."""
    place = _READS.get(call.method) or _WRITES.get(call.method)
    return param_use(call.method, call.string(0) or "", call.string(place))


def hidden_registration(
    registration: Registration, endpoint: Endpoint, caller: Caller, addressing: Addressing
) -> LocalAnswer:
    """The answer to a registration that the master is not told of."""
    caller = replace(caller, endpoint=endpoint)
    registry = addressing.registry
    fact = RegistryChange(registration, endpoint)
    if registration.kind is Kind.SERVICE:
        text = f"Registered [{registration.caller_id}] as provider of [{registration.name}]"
        return LocalAnswer(1, text, 1, fact)
    if registration.kind is Kind.PUBLISHER:
        endpoints: Iterable[Endpoint] = (
            e for e, _ in hidden_registrations.subscribers_inside(registry, registration.name)
        )
        text = f"Registered [{registration.caller_id}] as publisher of [{registration.name}]"
    else:
        endpoints = hidden_registrations.publishers_inside(registry, registration.name)
        text = f"Subscribed to [{registration.name}]"
    return LocalAnswer(1, text, _imported(dict.fromkeys(endpoints), caller, addressing), fact)


def hidden_unregistration(registration: Registration) -> LocalAnswer:
    """The answer to a call that ends a registration of which the master knows nothing."""
    # rosmaster says "provider" of topics as well (registrations.py, unregister).
    text = f"Unregistered [{registration.caller_id}] as provider of [{registration.name}]"
    return LocalAnswer(1, text, 1, RegistryChange(registration, None))


def hidden_service(call: Call, caller: Caller, addressing: Addressing) -> LocalAnswer | None:
    """The answer to lookupService, if the master does not know of the service."""
    endpoint = hidden_registrations.service(addressing.registry, second_parameter_name(call))
    if endpoint is None:
        return None
    uri = addressing.advertised_service(endpoint)
    imported = addressing.import_service(uri, second_parameter_name(call), caller)
    return LocalAnswer(1, f"rosrpc URI: [{imported}]", imported)


def hidden_node(call: Call, caller: Caller, addressing: Addressing) -> LocalAnswer | None:
    """The answer to lookupNode, if the master knows nothing of that node."""
    endpoint = hidden_registrations.node(addressing.registry, second_parameter_name(call))
    if endpoint is None:
        return None
    uri = addressing.import_slave(addressing.advertised_uri(endpoint), caller)
    return LocalAnswer(1, "node api", uri)


def denial(reason: str) -> str:
    """The text that a policy denies something, with the fix; ``reason`` names the rule."""
    return f"{reason}. Change that rule if the node may have this"


def no_provider(reason: str) -> LocalAnswer:
    """The answer to lookupService for a service that the node is not to find."""
    return LocalAnswer(-1, f"no provider (rosproxy: {denial(reason)})", "")


def no_publisher(topic: str, reason: str) -> list[object]:
    """The ROS triple of requestTopic for a topic that outside is not to have."""
    return [-1, f"Not a publisher of [{topic}] (rosproxy: {reason})", []]


def offers_tcpros_alone(call: Call) -> bool:
    """Whether a requestTopic offers no other protocol than TCPROS."""
    offers = call.params[2].items if len(call.params) > 2 else []
    return all(offer.items and offer.items[0].string() == "TCPROS" for offer in offers)


def publishers_for(
    endpoint: Endpoint | None, topic: str, at_master: Sequence[str], addressing: Addressing
) -> list[str]:
    """The publishers of a topic that the node of an endpoint is told of, as the master has them.

    ``at_master`` are those that the master has told. No endpoint: somebody outside.
    """
    registry = addressing.registry
    if endpoint is None:
        return [*at_master]
    if hidden_registrations.is_hidden_subscriber(registry, endpoint, topic):
        at_master = []
        extra = hidden_registrations.publishers_inside(registry, topic)
    else:
        extra = hidden_registrations.publishers(registry, topic)
    return [*dict.fromkeys([*at_master, *map(addressing.advertised_uri, extra)])]


def topic_names(topic: str, caller_id: str) -> tuple[str, ...]:
    """The names to which a node may resolve a topic as somebody outside has written it."""
    return tuple(dict.fromkeys((topic, resolve_name(topic, ""), resolve_name(topic, caller_id))))


def _searched_names(caller_id: str, name: str) -> tuple[str, ...]:
    """The names that searchParam looks at: in all namespaces of the caller, from its own up."""
    if name.startswith(("/", "~")):
        return (resolve_name(name, caller_id),)
    segments = [segment for segment in caller_id.split("/") if segment]
    namespaces = ("/".join(["", *segments[:count]]) for count in range(len(segments), -1, -1))
    return tuple(resolve_name(f"{namespace}/{name}", "") for namespace in namespaces)


def _imported(endpoints: Iterable[Endpoint], caller: Caller, addressing: Addressing) -> list[str]:
    uris = map(addressing.advertised_uri, endpoints)
    return [addressing.import_slave(uri, caller) for uri in uris]
