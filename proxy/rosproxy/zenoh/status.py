"""The state of the routers for rmw_zenoh: as a part of ``/status``, and as metrics."""

import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from operator import attrgetter
from types import MappingProxyType
from typing import NamedTuple, Protocol

from msgspec.structs import replace
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.documents.status_bounds import fair_choice
from rosproxy.shared.documents.status_document import (
    MismatchStatus,
    NamedTypeStatus,
    ZenohApartStatus,
    ZenohCertificateStatus,
    ZenohFullStatus,
    ZenohLinkStatus,
    ZenohNodeStatus,
    ZenohQosStatus,
    ZenohSessionStatus,
    ZenohStatus,
    ZenohUnlinkedStatus,
)
from rosproxy.shared.policy.rules import RuleKind
from rosproxy.shared.settings import Settings
from rosproxy.zenoh.links import Link, is_linked, left_behind
from rosproxy.zenoh.matching import Comparison, compare
from rosproxy.zenoh.peers_apart import PeersApart, peers_apart
from rosproxy.zenoh.protocol.liveliness import TokenGraph, TopicQos, ZenohNode
from rosproxy.zenoh.protocol.report import (
    MOST_SESSIONS,
    Ends,
    Report,
    RouterReport,
    RouterSession,
    all_ends_of,
    ends_of,
)
from rosproxy.zenoh.router_policy import InsideName

ROUTER = "router"
MODES = ("client", "peer", ROUTER)
MOST_LISTED_MISMATCHES = 100
"""Mismatches that the status lists, with fair shares by the address inside. As many pairs that
differ in durability alone are listed, too; further ones are not counted."""
MOST_LISTED_NODES = 1500
MOST_NAMES_APART = 3
"""Names of nodes at an address that do not reach other peers of their router."""
MOST_ADDRESSES_AT_FULL = 3
"""Addresses that the status names for a router that refuses sessions."""
MOST_LISTED_SESSIONS = 1500
"""Rows that the status lists, with fair shares by address. The live page shows as many nodes."""


class _PlacedSession(NamedTuple):
    """A session with the port of its router, and with both ends.

    The port is None for the router for outside, the router of the links to other sites, and the
    hub: the nodes of all three are outside. ``at_link``: the second of these three.
    """

    port: int | None
    session: RouterSession
    ends: Ends
    at_link: bool


class Reading(NamedTuple):
    """What the latest report and the latest tokens say, ready for the status.

    ``routers`` are the ends of the sessions with other routers, and whether each is of the router
    of the links. ``names`` are the topics and services of nodes inside, and ``counts`` the numbers
    of nodes inside and outside. ``without_node`` has the times since which no node is known of a
    session at a port for containers, by port and zenoh ID. ``apart`` has the peers of routers
    outside that do not reach each other, with the times since which that is known. ``full`` has the
    routers that refuse sessions. ``unlinked`` has the ports of all other routers without a link to
    the hub, with the times since which that is known. The other fields have the listed rows.
    ``mismatches`` are also pairs that differ in durability alone.
    """

    sessions: tuple[_PlacedSession, ...] = ()
    routers: tuple[tuple[bool, Ends], ...] = ()
    link_listens: bool = True
    graph: TokenGraph = TokenGraph()
    left_out: int = 0
    comparison: Comparison = Comparison()
    inside: frozenset[str] | None = None
    without_node: Mapping[tuple[int, str], float] = MappingProxyType({})
    apart: Mapping[PeersApart, float] = MappingProxyType({})
    full: tuple[ZenohFullStatus, ...] = ()
    unlinked: Mapping[int, float] = MappingProxyType({})
    nodes: tuple[ZenohNodeStatus, ...] = ()
    rows: tuple[ZenohSessionStatus, ...] = ()
    rows_left_out: int = 0
    names: tuple[InsideName, ...] = ()
    counts: tuple[int, int] = (0, 0)
    mismatches: tuple[MismatchStatus, ...] = ()
    mismatches_left_out: int = 0


class RouterProcess(Protocol):
    """What the status needs from the `RouterSupervisor`."""

    failure: str
    restarts: int


class ZenohState(Collector):
    """The state of the routers, from their latest report."""

    def __init__(
        self,
        settings: Settings,
        process: RouterProcess,
        now: Callable[[], float],
        certificates: Callable[[], tuple[ZenohCertificateStatus, ...]] = tuple,
    ) -> None:
        self._settings = settings
        self._certificates = certificates
        self._process = process
        self._now = now
        self._reading = Reading()
        hubs = dict.fromkeys(settings.zenoh_hub, True)
        peers = dict.fromkeys(settings.zenoh_peer, False)
        listeners = (settings.zenoh_listen, settings.zenoh_hub_listen)
        self._listen = frozenset(port for port in listeners if port is not None)
        self.links = [Link(peer, now(), is_hub) for peer, is_hub in (peers | hubs).items()]
        for site in dict.fromkeys(settings.zenoh_link):
            self.links.append(Link(site.peer, now(), protocol=site.protocol))

    def take(self, report: Report, graph: TokenGraph | None) -> None:
        """Replace the sessions by those of a report, and the nodes by those of its tokens.

        ``graph``: what the tokens announce; None if the tokens have not changed.
        """
        self.show(self.read(report, graph))

    def show(self, reading: Reading) -> None:
        """Use a reading from now on."""
        self._reading = reading

    def read(self, report: Report, graph: TokenGraph | None) -> Reading:
        """A reading, without any effect. For the most tokens this takes 0.3 s.

        What depends on the sessions of nodes and on the tokens alone stays without a change.
        """
        former = self._reading
        sessions = tuple(self._sessions_of(report.routers))
        reading = former._replace(
            sessions=sessions,
            routers=tuple(
                (placed.at_link, ends)
                for placed in sessions
                if placed.port is None and placed.session.whatami == ROUTER
                for ends in all_ends_of(placed.session)
            ),
        )
        if (port := self._settings.zenoh_link_listen) and report.routers:
            # The last router is the hub, which may listen by TLS, too.
            at = report.routers[-2:][0].locators
            listens = any(locator.startswith(f"{port.protocol}/") for locator in at)
            reading = reading._replace(link_listens=listens)
        if graph is not None:
            left_out = report.tokens_left_out + graph.left_out
            reading = reading._replace(graph=graph, left_out=left_out)
        inside = frozenset(s.session.peer for s in sessions if s.port is not None)
        if graph is not None or inside != former.inside:
            comparison = compare(reading.graph.entities, inside)
            reading = reading._replace(comparison=comparison, inside=inside)
        known = _without_node(former.without_node, sessions, reading.graph.nodes, self._now())
        apart = _apart(former.apart, sessions, report, self._now())
        by_port = dict(self._by_port(report.routers))
        full = tuple(_full(by_port))
        unlinked = _unlinked(former.unlinked, by_port, report.routers[-1:], self._now())
        reading = reading._replace(without_node=known, apart=apart, full=full, unlinked=unlinked)
        return reading if graph is None and sessions == former.sessions else _with_rows(reading)

    def is_up(self, link: Link) -> bool:
        """Whether the routers run, and have a session with the peer of a link."""
        at_links = self._settings.zenoh_link_listen
        listen = self._listen
        if link.is_to_site:
            listen = frozenset([at_links.port] if at_links else [])
        routers = (ends for at_link, ends in self._reading.routers if at_link is link.is_to_site)
        return not self._process.failure and is_linked(link.peer, link.addresses, routers, listen)

    def left_behind(self, link: Link) -> set[HostPort]:
        """The ends of the hub's sessions with former addresses of a peer."""
        routers = (ends for at_link, ends in self._reading.routers if not at_link)
        return left_behind(link, self.links, routers)

    @property
    def unlinked(self) -> Mapping[int, float]:
        """The ports of the proxy's routers without a link to the hub; see `Reading`."""
        return self._reading.unlinked

    @property
    def container_sessions(self) -> list[tuple[int, str]]:
        """The port and the address of each session with a container."""
        sessions = self._reading.sessions
        return [(s.port, s.ends.remote.host) for s in sessions if s.port is not None]

    def inside_names(self) -> tuple[InsideName, ...]:
        """The topics and services of the nodes with a session at a port for containers."""
        return self._reading.names

    def status(self, not_judged: Collection[tuple[int, str, str]] = ()) -> ZenohStatus:
        """The part of the status. ``not_judged``: the result of `RouterPolicy.not_judged`."""
        failure = self._process.failure
        if failure:  # all else is of a process that has ended
            return self._status_of_routers(failure)
        reading = self._reading
        nodes = reading.nodes
        if not_judged:
            nodes = tuple(
                replace(n, not_judged=True) if (n.port, n.address, n.name) in not_judged else n
                for n in nodes
            )
        return replace(
            self._status_of_routers(failure),
            sessions=tuple(self._with_age(row, reading.without_node) for row in reading.rows),
            nodes=nodes,
            left_out=reading.left_out + reading.rows_left_out,
            mismatches=reading.mismatches,
            mismatches_left_out=reading.mismatches_left_out,
            not_compared=reading.comparison.not_compared,
            apart=tuple(self._apart_status()),
            full=reading.full,
            unlinked=tuple(
                ZenohUnlinkedStatus(port, round(max(self._now() - since, 0.0), 1))
                for port, since in reading.unlinked.items()
            ),
        )

    def _apart_status(self) -> Iterator[ZenohApartStatus]:
        """Yield the peers of routers outside that do not reach each other, with their nodes."""
        reading = self._reading
        if not reading.apart:
            return
        remotes = {placed.session.peer: placed.ends.remote for placed in reading.sessions}
        by_session: dict[str, list[str]] = {}
        for node in reading.graph.nodes:
            by_session.setdefault(node.session, []).append(node.name)
        for peers, since in reading.apart.items():
            names = {name for zid in peers.sessions for name in by_session.get(zid, ())}
            yield ZenohApartStatus(
                str(remotes.get(peers.router, "")),
                peers.address,
                tuple(sorted(names)[:MOST_NAMES_APART]),
                own_address=peers.is_own_address,
                since=round(max(self._now() - since, 0.0), 1),
            )

    def _status_of_routers(self, failure: str) -> ZenohStatus:
        return ZenohStatus(
            ports=str(self._settings.zenoh_ports),
            listen=self._settings.zenoh_listen,
            hub_listen=self._settings.zenoh_hub_listen,
            link_listen=str(self._settings.zenoh_link_listen or ""),
            link_listens=self._reading.link_listens,
            limits=tuple(map(str, self._settings.zenoh_limit)),
            certificates=self._certificates(),
            failure=failure,
            restarts=self._process.restarts,
            links=tuple(map(self._link, self.links)),
        )

    def collect(self) -> Iterable[Metric]:
        """The state as metrics."""
        status = self.status()
        yield GaugeMetricFamily(
            "rosproxy_zenoh_routers_up", "1 if the zenoh routers run.", float(not status.failure)
        )
        yield CounterMetricFamily(
            "rosproxy_zenoh_restarts", "Times that the zenoh routers have ended.", status.restarts
        )
        links = GaugeMetricFamily(
            "rosproxy_zenoh_link_up", "1 if the link to a router outside is up.", labels=["peer"]
        )
        for link in status.links:
            if not link.hub:
                links.add_metric([link.title], float(link.up))
        hubs = GaugeMetricFamily(
            "rosproxy_zenoh_hubs_up",
            "Proxies on other hosts to which the hub is linked.",
            sum(1 for link in status.links if link.hub and link.up),
        )
        sessions = GaugeMetricFamily(
            "rosproxy_zenoh_sessions", "Sessions of the zenoh routers by mode.", labels=["mode"]
        )
        reading = Reading() if status.failure else self._reading
        modes = Counter(placed.session.whatami for placed in reading.sessions)
        for mode in MODES:
            sessions.add_metric([mode], modes[mode])
        full = GaugeMetricFamily(
            "rosproxy_zenoh_routers_full", "Routers that refuse sessions.", len(reading.full)
        )
        nodes = GaugeMetricFamily(
            "rosproxy_zenoh_nodes", "Nodes of rmw_zenoh by side.", labels=["side"]
        )
        for side, count in zip(("inside", "outside"), reading.counts, strict=True):
            nodes.add_metric([side], count)
        files = GaugeMetricFamily(
            "rosproxy_zenoh_certificate_expiry_seconds",
            "When a certificate for links to other sites, or to other hubs, expires, in seconds of "
            "Unix time.",
            labels=["file"],
        )
        for file in status.certificates:
            if file.ends_in is not None:
                files.add_metric([file.file], time.time() + file.ends_in)
        yield from (links, hubs, sessions, full, nodes, files)

    def _sessions_of(self, routers: Sequence[RouterReport]) -> Iterator[_PlacedSession]:
        """The sessions with programs other than the routers themselves.

        A container can take the zenoh ID of a router, and rules for its address hold all the same.
        So at a port for containers, a session is with a router only if that router reports it, too.
        """
        own = {router.zid for router in routers}
        ends_of_own = [
            ends
            for router in routers
            for session in router.sessions
            if session.peer in own
            for ends in all_ends_of(session)
        ]
        between = {Ends(ends.remote, ends.local) for ends in ends_of_own} & {*ends_of_own}
        for_outside = [] if self._settings.zenoh_listen is None else [None]
        for_links = [None] if self._settings.has_site_links else []
        ports = [*self._settings.zenoh_ports.ports(), *for_outside, *for_links, None]
        at_link = len(ports) - 2 if for_links else None
        for index, (port, router) in enumerate(zip(ports, routers, strict=False)):
            for session in router.sessions:
                ends = ends_of(session)
                is_own = session.peer in own and (port is None or ends in between)
                if ends and not is_own:
                    yield _PlacedSession(port, session, ends, index == at_link)

    def _by_port(self, routers: Sequence[RouterReport]) -> Iterator[tuple[int, RouterReport]]:
        """Yield the port and the report of each router with a port."""
        settings = self._settings
        at_links = settings.zenoh_link_listen
        ports: list[int | None] = [*settings.zenoh_ports.ports()]
        ports += [] if settings.zenoh_listen is None else [settings.zenoh_listen]
        ports += [at_links.port if at_links else None] if settings.has_site_links else []
        for port, router in zip([*ports, settings.zenoh_hub_listen], routers, strict=False):
            if port is not None:
                yield port, router

    def _with_age(
        self, row: ZenohSessionStatus, without_node: Mapping[tuple[int, str], float]
    ) -> ZenohSessionStatus:
        """The row of a session, with the time in which no node is known."""
        since = None if row.port is None else without_node.get((row.port, row.zid))
        age = 0.0 if since is None else round(max(self._now() - since, 0.0), 1)
        return replace(row, without_node=age) if age else row

    def _link(self, link: Link) -> ZenohLinkStatus:
        return ZenohLinkStatus(
            peer=str(link.peer),
            up=link.fault is None,
            error=link.fault.value if link.fault else "",
            since=round(max(self._now() - link.since, 0.0), 1),
            hub=link.is_hub,
            protocol=link.protocol,
        )


def _full(routers: Mapping[int, RouterReport]) -> Iterator[ZenohFullStatus]:
    """Yield the routers that refuse further sessions. ``routers``: the reports by port."""
    for port, router in routers.items():
        if router.is_full:
            ends = filter(None, map(ends_of, router.sessions))
            hosts = Counter(end.remote.host for end in ends)
            yield ZenohFullStatus(
                port,
                len(router.sessions),
                tuple(host for host, _ in hosts.most_common(MOST_ADDRESSES_AT_FULL)),
                few_files=router.most_sessions < MOST_SESSIONS,
            )


def _unlinked(
    former: Mapping[int, float],
    routers: Mapping[int, RouterReport],
    hub: Sequence[RouterReport],
    now: float,
) -> dict[int, float]:
    """The times since which routers have no link to the hub, as in `Reading`.

    ``former``: these times before. ``routers``: the reports by port; ``hub`` is empty without.
    """
    linked = {router.zid for router in hub}
    linked |= {session.peer for router in hub for session in router.sessions}
    return {
        port: former.get(port, now)
        for port, router in routers.items()
        if router.zid not in linked and not router.is_full
    }


def _without_node(
    former: Mapping[tuple[int, str], float],
    sessions: Sequence[_PlacedSession],
    nodes: Iterable[ZenohNode],
    now: float,
) -> dict[tuple[int, str], float]:
    """The times since which no node is known of a session, as in `Reading`.

    ``former``: these times before. The nodes behind a router have sessions with that router, which
    the proxy does not see. So the first node without a session here counts for each router.
    """
    announced = {node.session for node in nodes}
    is_any_behind = bool(announced.difference(placed.session.peer for placed in sessions))
    silent: dict[tuple[int, str], float] = {}
    for port, session, *_ in sessions:
        is_known = is_any_behind if session.whatami == ROUTER else session.peer in announced
        if port is not None and not is_known:
            silent[port, session.peer] = former.get((port, session.peer), now)
    return silent


def _apart(
    former: Mapping[PeersApart, float],
    sessions: Sequence[_PlacedSession],
    report: Report,
    now: float,
) -> dict[PeersApart, float]:
    """The peers of routers outside that do not reach each other, as in `Reading`.

    ``former``: these times before. They go on if other peers at the address come and go.
    """
    if not report.routers:
        return {}
    outside = [s.session.peer for s in sessions if s.port is None and s.session.whatami == ROUTER]
    since = {(peers.router, peers.address): time for peers, time in former.items()}
    found = peers_apart(outside, report.routers[-1].zid, report.outside)
    return {peers: since.get((peers.router, peers.address), now) for peers in found}


def _with_rows(reading: Reading) -> Reading:
    """The reading with the rows of the status."""
    by_zid = {placed.session.peer: placed for placed in reading.sessions}
    nodes = tuple(_node_status(node, by_zid.get(node.session)) for node in reading.graph.nodes)
    sessions = fair_choice(reading.sessions, attrgetter("ends.remote.host"), MOST_LISTED_SESSIONS)
    listed = fair_choice(nodes, attrgetter("address"), MOST_LISTED_NODES)
    addresses = {node.key: node.address for node in nodes if node.port is not None}
    inside = sum(1 for node in nodes if node.port is not None)

    def owner(pair: MismatchStatus) -> str:
        return addresses.get(pair.writer, addresses.get(pair.reader, ""))

    comparison = reading.comparison
    shown = fair_choice(comparison.mismatches, owner, MOST_LISTED_MISMATCHES)
    late = fair_choice(comparison.late, owner, MOST_LISTED_MISMATCHES)
    return reading._replace(
        nodes=tuple(listed),
        rows=tuple(map(_session_status, sessions)),
        rows_left_out=len(nodes) - len(listed) + len(reading.sessions) - len(sessions),
        names=tuple(_inside_names(nodes)),
        counts=(inside, len(nodes) - inside),
        mismatches=(*shown, *late),
        mismatches_left_out=comparison.left_out + len(comparison.mismatches) - len(shown),
    )


def _inside_names(nodes: Iterable[ZenohNodeStatus]) -> Iterator[InsideName]:
    """The topics and services of the nodes with a session at a port for containers."""
    for node in nodes:
        if node.port is None:
            continue
        for kind, of_kind in (
            (RuleKind.PUBLISH, node.publishes),
            (RuleKind.SUBSCRIBE, node.subscribes),
            (RuleKind.SERVE, node.services),
            (RuleKind.CALL, node.calls),
        ):
            for name in of_kind:
                yield InsideName(node.port, node.address, node.name, kind, name)


def _session_status(placed: _PlacedSession) -> ZenohSessionStatus:
    port, session, ends, at_link = placed
    return ZenohSessionStatus(
        port, session.whatami, session.peer, str(ends.local), str(ends.remote), at_link
    )


def _node_status(node: ZenohNode, placed: _PlacedSession | None) -> ZenohNodeStatus:
    """A node. ``placed``: the session of the node with a router of the proxy; None: none."""
    port, session, ends = placed[:3] if placed else (None, None, None)
    return ZenohNodeStatus(
        node.name,
        node.domain,
        ends.remote.host if ends else "",
        node.publishes,
        node.subscribes,
        node.services,
        calls=node.calls,
        types=tuple(NamedTypeStatus(name, ros) for name, ros in node.types),
        port=port,
        mode=session.whatami if session else "",
        key=node.key,
        qos=tuple(map(_qos_status, node.qos)),
    )


def _qos_status(of_topic: TopicQos) -> ZenohQosStatus:
    kind = "publisher" if of_topic.is_publisher else "subscription"
    return ZenohQosStatus(of_topic.name, kind, *of_topic.qos)
