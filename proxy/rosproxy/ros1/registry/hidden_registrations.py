"""What the policy keeps from the master, and how nodes inside find each other all the same.

A denied registration is hidden: the master, and so outside, is told nothing of it. For nodes inside
the proxy does the master's part. A subscriber hears of hidden publishers besides those that the
master names; a hidden subscriber hears of the publishers inside, hidden or not, and of none
outside; a hidden service is found by its name.
"""

from collections.abc import Iterable

from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import Endpoint, EndpointRegistration
from rosproxy.ros1.registry.registry import Registry


def publishers(registry: Registry, topic: str) -> list[Endpoint]:
    """The nodes whose publishing of a topic is hidden, without those that are given up."""
    endpoints = registry.hidden.get((Kind.PUBLISHER, topic), {}).values()
    return _living(endpoints)


def publishers_inside(registry: Registry, topic: str) -> list[Endpoint]:
    """All nodes inside that publish a topic."""
    return _living(endpoint for endpoint in registry if endpoint.publishes(topic))


def is_hidden_subscriber(registry: Registry, endpoint: Endpoint, topic: str) -> bool:
    """Whether the master does not know that a node subscribes to a topic."""
    return endpoint in registry.hidden.get((Kind.SUBSCRIBER, topic), {}).values()


def subscribers_inside(registry: Registry, topic: str) -> list[EndpointRegistration]:
    """All subscriptions of nodes inside to a topic."""
    return [
        (endpoint, registration)
        for endpoint, registration in registry.registrations()
        if registration.kind is Kind.SUBSCRIBER and registration.name == topic
    ]


def service(registry: Registry, name: str) -> Endpoint | None:
    """The node that has a hidden service."""
    providers = _living(registry.hidden.get((Kind.SERVICE, name), {}).values())
    return providers[0] if providers else None


def node(registry: Registry, caller_id: str) -> Endpoint | None:
    """The node of a name of which the master knows nothing at all."""
    endpoint = registry.by_caller.get(caller_id)
    if endpoint is None or endpoint.health.cleaned:
        return None
    registrations = [r for r in endpoint.registrations.values() if r.caller_id == caller_id]
    return endpoint if all(r.hidden for r in registrations) else None


def _living(endpoints: Iterable[Endpoint]) -> list[Endpoint]:
    by_id = {id(endpoint): endpoint for endpoint in endpoints if not endpoint.health.cleaned}
    return sorted(by_id.values(), key=lambda endpoint: endpoint.port)
