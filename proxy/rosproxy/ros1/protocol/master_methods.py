"""The methods of the master API with addresses: in which parameters, and where in the reply.

Sources: http://wiki.ros.org/ROS/Master_API, http://wiki.ros.org/ROS/Parameter%20Server%20API and
ros_comm/tools/rosmaster/src/rosmaster/master_api.py. The proxy forwards a method without an entry
unchanged.
"""

from enum import Enum

import msgspec


class Kind(Enum):
    """The kinds of a registration."""

    PUBLISHER = "publisher"
    SUBSCRIBER = "subscriber"
    SERVICE = "service"
    PARAM = "param"


class Reply(Enum):
    """The content of the third element of a reply."""

    OTHER = 0
    SLAVE_URI = 1
    SLAVE_URIS = 2
    SERVICE_URI = 3
    MASTER_URI = 4


class MethodSpec(msgspec.Struct, frozen=True):
    """A method: positions of parameters, the kind that it (un)registers, and its reply."""

    name: int | None = None
    type: int | None = None
    service_api: int | None = None
    caller_api: int | None = None
    registers: Kind | None = None
    unregisters: Kind | None = None
    reply: Reply = Reply.OTHER


MASTER_METHODS: dict[str, MethodSpec] = {
    "registerService": MethodSpec(name=1, service_api=2, caller_api=3, registers=Kind.SERVICE),
    "unregisterService": MethodSpec(name=1, service_api=2, unregisters=Kind.SERVICE),
    "registerSubscriber": MethodSpec(
        name=1, type=2, caller_api=3, registers=Kind.SUBSCRIBER, reply=Reply.SLAVE_URIS
    ),
    "unregisterSubscriber": MethodSpec(name=1, caller_api=2, unregisters=Kind.SUBSCRIBER),
    "registerPublisher": MethodSpec(
        name=1, type=2, caller_api=3, registers=Kind.PUBLISHER, reply=Reply.SLAVE_URIS
    ),
    "unregisterPublisher": MethodSpec(name=1, caller_api=2, unregisters=Kind.PUBLISHER),
    "subscribeParam": MethodSpec(name=2, caller_api=1, registers=Kind.PARAM),
    "unsubscribeParam": MethodSpec(name=2, caller_api=1, unregisters=Kind.PARAM),
    "lookupNode": MethodSpec(reply=Reply.SLAVE_URI),
    "lookupService": MethodSpec(reply=Reply.SERVICE_URI),
    "getUri": MethodSpec(reply=Reply.MASTER_URI),
}

NO_SPEC = MethodSpec()

GRAPH_METHODS = frozenset({"getPublishedTopics", "getSystemState", "getTopicTypes"})
"""The calls whose replies contain the graph: the names of topics, services and nodes."""
MASTER_ONLY = frozenset({"shutdown", "publisherUpdate", "paramUpdate"})
"""The calls of the master to nodes. A policy may refuse these calls from all other callers."""
_PARAMETERS = {"deleteParam", "getParam", "getParamNames", "hasParam", "searchParam", "setParam"}
_NODES = {"getBusInfo", "getBusStats", "getMasterUri", "getName", "getPid", "shutdown"}
_TOPICS = {"getPublications", "getSubscriptions", "publisherUpdate", "requestTopic", "paramUpdate"}
KNOWN_METHODS = GRAPH_METHODS.union(
    MASTER_METHODS, _PARAMETERS, _NODES, _TOPICS, {"system.multicall"}
)
"""The methods of both APIs. Metrics count all other names together."""


def method_spec(method: str) -> MethodSpec:
    """What to rewrite for a method; an empty spec if there is nothing to rewrite."""
    return MASTER_METHODS.get(method, NO_SPEC)


def resolve_name(name: str, caller_id: str) -> str:
    """The global name that the master resolves a name to (http://wiki.ros.org/Names)."""
    if name.startswith("/"):
        resolved = name
    elif name.startswith("~"):
        resolved = f"{caller_id}/{name[1:]}"
    else:
        resolved = f"{caller_id.rpartition('/')[0]}/{name}"
    # As in rosgraph (rosgraph/names.py, canonicalize_name).
    return "/" + "/".join(filter(None, resolved.split("/")))


def prefix(name: str) -> str:
    """The beginning of all names below a parameter."""
    return name if name.endswith("/") else f"{name}/"
