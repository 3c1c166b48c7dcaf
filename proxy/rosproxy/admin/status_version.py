"""The version of a proxy's status. Nodes, ports and problems change the version, rates do not.

``/status/changes`` answers waiting callers when the version differs.
"""

import hashlib

import msgspec
from msgspec.structs import replace

from rosproxy.shared.documents.status_document import (
    DomainStatus,
    EndpointStatus,
    ProxyStatus,
    ZenohStatus,
)


def version_of(status: ProxyStatus) -> str:
    """A hash of the parts of the status that matter to an operator."""
    parts = (
        status.instance,
        status.retired,
        status.master.up,
        status.master.error,
        [_node(node) for node in status.nodes],
        [_domain(domain) for domain in status.domains],
        _zenoh(status.zenoh) if status.zenoh else None,
        sorted((problem.subject, problem.text) for problem in status.problems),
        replace(status.range_probe, age=0.0) if status.range_probe else None,
    )
    return hashlib.sha256(msgspec.json.encode(parts)).hexdigest()[:16]


def _node(node: EndpointStatus) -> object:
    return node.nodes, node.address, node.given_up, node.publishes, node.subscribes


def _domain(domain: DomainStatus) -> object:
    inside = [
        (
            participant.guid_prefix,
            participant.address,
            participant.publishes,
            participant.subscribes,
            [lease.port for lease in participant.leases],
        )
        for participant in domain.inside
    ]
    return domain.domain, inside


def _zenoh(zenoh: ZenohStatus) -> object:
    links = [(link.title, link.up, link.error) for link in zenoh.links]
    files = [(certificate.file, certificate.error) for certificate in zenoh.certificates]
    sessions = [replace(s, without_node=0.0) if s.without_node else s for s in zenoh.sessions]
    return zenoh.failure, links, zenoh.link_listens, files, sessions, zenoh.nodes
