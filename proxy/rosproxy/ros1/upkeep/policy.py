"""The calls by which the proxy registers and unregisters at the master on behalf of nodes."""

from collections.abc import Collection, Mapping
from typing import Any

from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import Endpoint, Registration
from rosproxy.ros1.rewriting.addressing import Addressing

MethodCall = tuple[str, list[Any]]
"""A method and its parameters, the caller_id first."""


def register_call(endpoint: Endpoint, held: Registration, addressing: Addressing) -> MethodCall:
    """The call that makes a registration at the master."""
    service = addressing.advertised_service(endpoint)
    return registering(held, addressing.advertised_uri(endpoint), service)


def unregister_call(endpoint: Endpoint, held: Registration, addressing: Addressing) -> MethodCall:
    """The call that takes a registration back; the master wants the URI exactly as registered."""
    service = addressing.advertised_service(endpoint)
    return unregistering(held, addressing.advertised_uri(endpoint), service)


def registering(held: Registration, uri: str, service: str) -> MethodCall:
    """The call that makes a registration with a slave URI, and for a service with its URI."""
    match held.kind:
        case Kind.PUBLISHER:
            return "registerPublisher", [held.caller_id, held.name, held.type, uri]
        case Kind.SUBSCRIBER:
            return "registerSubscriber", [held.caller_id, held.name, held.type, uri]
        case Kind.SERVICE:
            return "registerService", [held.caller_id, held.name, service, uri]
        case Kind.PARAM:
            return "subscribeParam", [held.caller_id, uri, held.name]


def unregistering(held: Registration, uri: str, service: str) -> MethodCall:
    """The call that takes back a registration that was made with these URIs."""
    match held.kind:
        case Kind.PUBLISHER:
            return "unregisterPublisher", [held.caller_id, held.name, uri]
        case Kind.SUBSCRIBER:
            return "unregisterSubscriber", [held.caller_id, held.name, uri]
        case Kind.SERVICE:
            return "unregisterService", [held.caller_id, held.name, service]
        case Kind.PARAM:
            return "unsubscribeParam", [held.caller_id, uri, held.name]


def left_over(
    endpoint: Endpoint, published: Collection[str], subscribed: Collection[str], before: float
) -> list[Registration]:
    """Which of an endpoint's registrations a process that is gone has left behind.

    A topic is, if the node does not name it; a whole node name is, if another has registered
    since and none of its topics, apart from everybody's /rosout, holds. Registrations made after
    ``before`` are not.
    """
    topics = {Kind.PUBLISHER: published, Kind.SUBSCRIBER: subscribed}
    everything = list(endpoint.registrations.values())
    newest = max(everything, key=lambda held: held.since, default=None)
    alive = {
        held.caller_id
        for held in everything
        if held is newest or (held.name != "/rosout" and held.name in topics.get(held.kind, ()))
    }
    return [
        held
        for held in everything
        if held.since < before
        and (held.caller_id not in alive or held.name not in topics.get(held.kind, (held.name,)))
    ]


def still_held(
    endpoint: Endpoint, published: Collection[str], subscribed: Collection[str], same_process: bool
) -> list[Registration]:
    """Which of an endpoint's registrations hold for a node that has come back.

    Topics count if the node itself names them; services and parameters, which it can't be asked
    for, only if it is the ``same_process`` and at least one topic holds.
    """
    topics = {Kind.PUBLISHER: published, Kind.SUBSCRIBER: subscribed}
    everything = list(endpoint.registrations.values())
    kept = [held for held in everything if held.name in topics.get(held.kind, ())]
    if not (kept and same_process):
        return kept
    return kept + [held for held in everything if held.kind not in topics]


def unregistered(
    endpoint: Endpoint, published: Mapping[str, str], subscribed: Mapping[str, str]
) -> list[Registration]:
    """The topics that a node has, with their types, and the master does not know of.

    rospy gives up a registration for which it found no master. Nothing is said of a slave API
    that several node names share.
    """
    names = endpoint.caller_ids
    if len(names) != 1:
        return []
    said = {Kind.PUBLISHER: published, Kind.SUBSCRIBER: subscribed}
    return [
        Registration(kind, topic, names[0], type_)
        for kind, topics in said.items()
        for topic, type_ in topics.items()
        if (kind, topic, names[0]) not in endpoint.registrations
    ]
