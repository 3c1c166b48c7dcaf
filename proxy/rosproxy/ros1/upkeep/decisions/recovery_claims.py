"""Rebuilding the registry from what the master holds, after a start without memory.

The advertised URIs at the master tell the ports, and what the proxy remembers where their nodes
are; those of former versions carry that in their path. Anybody can write both to the master, so
what is found there is only a claim. Where several claim one port, or one node, the one that its
node bears out best is kept (`choose_claims`); the node of one that is kept is asked before it is
served (`confirmed_by`).
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from rosproxy.net.addresses import HostPort
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.protocol.uris import parse_inside_path, slave_uri
from rosproxy.ros1.registry.endpoint import Registration
from rosproxy.ros1.registry.graph import ROSOUT, TOPIC_KINDS, Graph, NodeInfo
from rosproxy.ros1.registry.remembered_leases import RememberedLease
from rosproxy.ros1.rewriting.addressing import Addressing

NO_MERIT = -(10**9)
"""The merit of a node that has not answered: less than that of any that has."""
MOST_ASKED = 3
"""How many topics, and services, a node is asked for at most."""


@dataclass(slots=True)
class Claim:
    """An endpoint that the master's data tell of: its port, its inside address, what it holds.

    ``node`` is the host and port that the node calls itself, ``path`` its URI's, ``slave`` where to
    look for it, ``advertised`` the URI that the master has.
    ``node_info`` is what it says of itself; None if it was not asked or gave no answer.
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
        """The topics that the master has for it."""
        return {r.name for r in self.registrations if r.kind in TOPIC_KINDS}

    @property
    def uri(self) -> str:
        """The slave URI as the node must have given it."""
        return slave_uri(self.node, self.path)


def find_claims(
    graph: Graph, addressing: Addressing, memory: Mapping[int, RememberedLease]
) -> tuple[list[Claim], dict[str, list[Registration]]]:
    """The endpoints of this proxy among the nodes of a master, by what it remembers of each port.

    Second, by URI, what the master has by advertised URIs of which nothing is remembered.
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
    """The claims that share their port or their inside address with another."""
    ports = Counter(c.port for c in candidates)
    slaves = Counter(c.slave for c in candidates)
    return [claim for claim in candidates if ports[claim.port] > 1 or slaves[claim.slave] > 1]


def choose_claims(candidates: Sequence[Claim]) -> list[Claim]:
    """One claim per port and inside address: the one that its node bears out best."""

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
    """Whether what a node says of its topics bears out what is registered for it.

    A forged URI that leads to something other than the node of that name finds no answer here,
    or one of another node. None: it does not tell, or no topic is registered.
    """
    topics = {r.name for r in registrations if r.kind in TOPIC_KINDS}
    answers = [info.has(topic) for topic in (topics - {ROSOUT} or topics)]
    if any(answers):
        return True
    return False if answers and None not in answers else None


def has_own_topic(registrations: Iterable[Registration]) -> bool:
    """Whether a topic is registered that not every node has."""
    return any(r.kind in TOPIC_KINDS and r.name != ROSOUT for r in registrations)


def by_name(registrations: Iterable[Registration]) -> dict[str, list[Registration]]:
    """Registrations by the node names that have made them.

    Several names at one slave URI are several processes, as a rule: a port is used again, and the
    master keeps what the one before had until it is taken back.
    """
    registrations_by_name: dict[str, list[Registration]] = {}
    for registration in registrations:
        registrations_by_name.setdefault(registration.caller_id, []).append(registration)
    return registrations_by_name


def unconfirmed_registrations(
    registrations: Iterable[Registration], info: NodeInfo
) -> list[Registration]:
    """The registrations of names that a node does not bear out by what it says of itself."""
    groups = by_name(registrations).values()
    return [r for group in groups if confirmed_by(group, info) is False for r in group]


def topics_and_services_to_ask(
    registrations: Iterable[Registration],
) -> tuple[list[str], list[Registration]]:
    """The topics and services by which a node can show that it is the one that registered them.

    It is asked for a few at most, everybody's /rosout last.
    """
    candidates = list(registrations)
    topics = {r.name for r in candidates if r.kind is Kind.PUBLISHER}
    services = [r for r in candidates if r.kind is Kind.SERVICE]
    return sorted(topics, key=lambda topic: (topic == ROSOUT, topic))[:MOST_ASKED], (
        sorted(services, key=lambda r: r.name)[:MOST_ASKED]
    )
