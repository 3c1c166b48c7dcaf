"""Rebuilding the registry from what the master holds, after a start without memory.

The advertised URIs at the master tell the ports, and what the proxy remembers where their nodes
are; those of former versions carry that in their path. Anybody can write both to the master, so
what is found there is only a claim. Where several claim one port, or one node, the one
that its node bears out best is kept (`settle`); the node of one that is kept is asked before it is
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
from rosproxy.ros1.registry.memory import Remembered
from rosproxy.ros1.rewriting.addressing import Addressing

NO_MERIT = -(10**9)
MOST_ASKED = 3
"""How many topics, and services, a node is asked for at most."""


@dataclass(slots=True)
class Claim:
    """An endpoint that the master's data tell of: its port, its inside address, what it holds.

    ``node`` is the host and port that the node calls itself, ``path`` its URI's, ``slave`` where to
    look for it, ``advertised`` the URI that the master has.
    ``said`` is what it says of itself; None if it was not asked or gave no answer.
    """

    port: int
    node: HostPort
    slave: HostPort
    registrations: list[Registration] = field(default_factory=list)
    said: NodeInfo | None = None
    advertised: str = ""
    path: str = "/"
    service_ports: tuple[int, ...] = ()

    @property
    def topics(self) -> set[str]:
        """The topics that the master has for it."""
        return {held.name for held in self.registrations if held.kind in TOPIC_KINDS}

    @property
    def uri(self) -> str:
        """The slave URI as the node must have given it."""
        return slave_uri(self.node, self.path)


def claims(
    graph: Graph, addressing: Addressing, memory: Mapping[int, Remembered]
) -> tuple[list[Claim], dict[str, list[Registration]]]:
    """The endpoints of this proxy among the nodes of a master, by what it remembers of each port.

    Second what the master has by advertised URIs of which nothing is remembered.
    """
    found, forgotten = dict[str, Claim](), dict[str, list[Registration]]()
    for node, uri in graph.uris.items():
        port = addressing.lease_of(uri)
        if port is None:
            continue
        lease, held = memory.get(port), graph.held.get(node, [])
        inside = parse_inside_path(uri) or (lease.node if lease else None)
        if inside is None:
            forgotten.setdefault(uri, []).extend(held)
            continue
        claim = Claim(port, inside.node, inside.slave, advertised=uri, path=inside.path)
        claim.service_ports = lease.service_ports if lease else ()
        found.setdefault(uri, claim).registrations += held
    return list(found.values()), forgotten


def contested(found: Sequence[Claim]) -> list[Claim]:
    """The claims that share their port or their inside address with another."""
    ports, slaves = Counter(c.port for c in found), Counter(c.slave for c in found)
    return [claim for claim in found if ports[claim.port] > 1 or slaves[claim.slave] > 1]


def settle(found: Sequence[Claim]) -> list[Claim]:
    """One claim per port and inside address: the one that its node bears out best."""

    def merit(claim: Claim) -> tuple[int, int]:
        count = len(claim.registrations)
        if claim.said is None:
            return NO_MERIT, count
        told = Counter(claim.said.has(topic) for topic in claim.topics)
        return told[True] - told[False], count

    ports: dict[int, Claim] = {}
    slaves: set[HostPort] = set()
    for claim in sorted(found, key=merit, reverse=True):
        if claim.port not in ports and claim.slave not in slaves:
            ports[claim.port] = claim
            slaves.add(claim.slave)
    return list(ports.values())


def confirmed_by(held: Iterable[Registration], info: NodeInfo) -> bool | None:
    """Whether what a node says of its topics bears out what is registered for it.

    A forged URI that leads to something other than the node of that name finds no answer here,
    or one of another node. None: it does not tell, or no topic is registered.
    """
    topics = {one.name for one in held if one.kind in TOPIC_KINDS}
    told = [info.has(topic) for topic in (topics - {ROSOUT} or topics)]
    if any(told):
        return True
    return False if told and None not in told else None


def by_name(registrations: Iterable[Registration]) -> dict[str, list[Registration]]:
    """Registrations by the node names that have made them.

    Several names at one slave URI are several processes, as a rule: a port is used again, and the
    master keeps what the one before had until it is taken back.
    """
    names: dict[str, list[Registration]] = {}
    for registration in registrations:
        names.setdefault(registration.caller_id, []).append(registration)
    return names


def others(registrations: Iterable[Registration], info: NodeInfo) -> list[Registration]:
    """What names have registered that the node which says this of itself does not bear out."""
    names = by_name(registrations).values()
    return [one for own in names if confirmed_by(own, info) is False for one in own]


def to_ask(held: Iterable[Registration]) -> tuple[list[str], list[Registration]]:
    """The topics and services by which a node can show that it is the one that registered them.

    It is asked for a few at most, everybody's /rosout last.
    """
    everything = list(held)
    topics = {one.name for one in everything if one.kind is Kind.PUBLISHER}
    services = [one for one in everything if one.kind is Kind.SERVICE]
    return sorted(topics, key=lambda topic: (topic == ROSOUT, topic))[:MOST_ASKED], (
        sorted(services, key=lambda one: one.name)[:MOST_ASKED]
    )
