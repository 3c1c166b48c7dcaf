"""Rebuild the registry from the data at the master, after a start of the proxy.

The advertised URIs at the master tell the ports. The parameter of the proxy
(`rosproxy.ros1.registry.remembered_leases`) tells where the nodes of these ports are; URIs of
former versions have the node in the path instead. Any program can write both to the master, so the
data are only claims. If several claims name the same port or the same node, `choose_claims` keeps
the claim that a node confirms best. Before the proxy serves a node, the node has to confirm the
claim (`confirmed_by`).
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import Registration
from rosproxy.ros1.registry.graph import ROSOUT, TOPIC_KINDS, Graph, NodeInfo
from rosproxy.ros1.registry.remembered_leases import RememberedLease
from rosproxy.ros1.rewriting.addressing import Addressing
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.uris import parse_inside_path, slave_uri

NO_MERIT = -(10**9)
"""The merit of a claim whose node has not answered: less than the merit of any other claim."""
MOST_ASKED = 3
"""The highest number of topics, and of services, that a node is asked for."""


@dataclass(slots=True)
class Claim:
    """A possible endpoint from the master's data: port, inside address and registrations.

    ``node`` is the host and port that the node gave, ``path`` the path of its URI, ``slave`` the
    address at which to look for the node, and ``advertised`` the URI at the master. ``node_info``
    is what the node says about itself; None if the proxy did not ask, or got no answer.
    """

    port: int
    node: HostPort
    slave: HostPort
    registrations: list[Registration] = field(default_factory=list)
    node_info: NodeInfo | None = None
    advertised: str = ""
    path: str = "/"
    service_ports: tuple[int, ...] = ()

    @property
    def topics(self) -> set[str]:
        """The topics that the master has for the node."""
        return {r.name for r in self.registrations if r.kind in TOPIC_KINDS}

    @property
    def uri(self) -> str:
        """The slave URI in the form that the node must have given."""
        return slave_uri(self.node, self.path)


def find_claims(
    graph: Graph, addressing: Addressing, memory: Mapping[int, RememberedLease]
) -> tuple[list[Claim], dict[str, list[Registration]]]:
    """Find the endpoints of this proxy among the nodes of a master.

    ``memory`` has the remembered lease of each port.

    Returns:
        The claims, and the registrations by advertised URI for ports without a remembered lease.
    """
    claims_by_uri = dict[str, Claim]()
    forgotten = dict[str, list[Registration]]()
    for node, uri in graph.uris.items():
        port = addressing.lease_of(uri)
        if port is None:
            continue
        lease = memory.get(port)
        registrations = graph.registrations.get(node, [])
        inside = parse_inside_path(uri) or (lease.node if lease else None)
        if inside is None:
            forgotten.setdefault(uri, []).extend(registrations)
            continue
        claim = Claim(port, inside.node, inside.slave, advertised=uri, path=inside.path)
        claim.service_ports = lease.service_ports if lease else ()
        claims_by_uri.setdefault(uri, claim).registrations += registrations
    return list(claims_by_uri.values()), forgotten


def contested_claims(candidates: Sequence[Claim]) -> list[Claim]:
    """The claims that share the port or the inside address with another claim."""
    ports = Counter(c.port for c in candidates)
    slaves = Counter(c.slave for c in candidates)
    return [claim for claim in candidates if ports[claim.port] > 1 or slaves[claim.slave] > 1]


def choose_claims(candidates: Sequence[Claim]) -> list[Claim]:
    """A single claim for each port and inside address: the claim that the node confirms best."""

    def merit(claim: Claim) -> tuple[int, int]:
        count = len(claim.registrations)
        if claim.node_info is None:
            return NO_MERIT, count
        counts = Counter(claim.node_info.has(topic) for topic in claim.topics)
        return counts[True] - counts[False], count

    claims_by_port: dict[int, Claim] = {}
    slaves: set[HostPort] = set()
    for claim in sorted(candidates, key=merit, reverse=True):
        if claim.port not in claims_by_port and claim.slave not in slaves:
            claims_by_port[claim.port] = claim
            slaves.add(claim.slave)
    return list(claims_by_port.values())


def confirmed_by(registrations: Iterable[Registration], info: NodeInfo) -> bool | None:
    """Whether the topics that a node names confirm the registrations.

    A forged URI may lead to a program that is not the node of that name. Then there is no answer
    here, or the topics of another node. None: no topic is registered, or the node tells only a part
    of its topics.
    """
    topics = {r.name for r in registrations if r.kind in TOPIC_KINDS}
    answers = [info.has(topic) for topic in (topics - {ROSOUT} or topics)]
    if any(answers):
        return True
    return False if answers and None not in answers else None


def has_own_topic(registrations: Iterable[Registration]) -> bool:
    """Whether a topic other than /rosout is registered."""
    return any(r.kind in TOPIC_KINDS and r.name != ROSOUT for r in registrations)


def by_name(registrations: Iterable[Registration]) -> dict[str, list[Registration]]:
    """Registrations by node name.

    Several names at the same slave URI usually mean several processes in a row. The later process
    uses the port again, and the master keeps the registrations of the earlier process until a
    program ends these registrations.
    """
    registrations_by_name: dict[str, list[Registration]] = {}
    for registration in registrations:
        registrations_by_name.setdefault(registration.caller_id, []).append(registration)
    return registrations_by_name


def unconfirmed_registrations(
    registrations: Iterable[Registration], info: NodeInfo
) -> list[Registration]:
    """The registrations of names that are refuted by what the node says about itself."""
    groups = by_name(registrations).values()
    return [r for group in groups if confirmed_by(group, info) is False for r in group]


def topics_and_services_to_ask(
    registrations: Iterable[Registration],
) -> tuple[list[str], list[Registration]]:
    """The published topics and the services by which a node can confirm the registrations.

    At most `MOST_ASKED` of each, with /rosout as the last topic.
    """
    candidates = list(registrations)
    topics = {r.name for r in candidates if r.kind is Kind.PUBLISHER}
    services = [r for r in candidates if r.kind is Kind.SERVICE]
    return sorted(topics, key=lambda topic: (topic == ROSOUT, topic))[:MOST_ASKED], (
        sorted(services, key=lambda r: r.name)[:MOST_ASKED]
    )
