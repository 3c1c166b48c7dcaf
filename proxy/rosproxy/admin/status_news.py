"""What of a proxy's status is news to an operator: not how long or how fast, but who and what.

Whoever waits for a change (``/status/changes``) is answered when this is another one.
"""

import hashlib

import msgspec

from rosproxy.admin.status_document import DomainStatus, EndpointStatus, ProxyStatus


def version_of(status: ProxyStatus) -> str:
    """The same text for as long as nothing of it is news."""
    told = (
        status.instance,
        status.retired,
        status.master.up,
        status.master.error,
        [_node(one) for one in status.nodes],
        [_domain(one) for one in status.domains],
        sorted((one.subject, one.text) for one in status.problems),
    )
    return hashlib.sha256(msgspec.json.encode(told)).hexdigest()[:16]


def _node(one: EndpointStatus) -> object:
    return one.nodes, one.address, one.given_up, one.publishes, one.subscribes


def _domain(one: DomainStatus) -> object:
    inside = [
        (
            member.guid_prefix,
            member.address,
            member.publishes,
            member.subscribes,
            [lease.port for lease in member.leases],
        )
        for member in one.inside
    ]
    return one.domain, inside
