"""The state of the routers for rmw_zenoh: as a part of ``/status``, and as metrics."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Protocol

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from rosproxy.access.rules import RuleKind
from rosproxy.admin.status_document import (
    ZenohLinkStatus,
    ZenohNodeStatus,
    ZenohSessionStatus,
    ZenohStatus,
)
from rosproxy.settings import Settings
from rosproxy.zenoh.links import Link, is_linked
from rosproxy.zenoh.protocol.liveliness import TokenGraph, ZenohNode
from rosproxy.zenoh.protocol.report import (
    Ends,
    Report,
    RouterReport,
    RouterSession,
    all_ends_of,
    ends_of,
)
from rosproxy.zenoh.router_policy import InsideName

MODES = ("client", "peer", "router")
_PlacedSession = tuple[int | None, RouterSession, Ends]
"""A session with the port of its router, which is None for the hub, and with both ends."""


class RouterProcess(Protocol):
    """What the status needs from the `RouterSupervisor`."""

    failure: str
    restarts: int


class ZenohState(Collector):
    """The state of the routers, from their latest report."""

    def __init__(
        self, settings: Settings, process: RouterProcess, now: Callable[[], float]
    ) -> None:
        self._settings = settings
        self._process = process
        self._now = now
        self._sessions: tuple[_PlacedSession, ...] = ()
        self._hub_routers: tuple[Ends, ...] = ()
        self._nodes: tuple[ZenohNode, ...] = ()
        self._left_out = 0
        hubs = dict.fromkeys(settings.zenoh_hub, True)
        peers = dict.fromkeys(settings.zenoh_peer, False)
        self.links = [Link(peer, now(), is_hub) for peer, is_hub in (peers | hubs).items()]

    def take(self, report: Report, graph: TokenGraph | None) -> None:
        """Replace the sessions by those of a report, and the nodes by those of its tokens.

        ``graph``: what the tokens announce; None if the tokens have not changed.
        """
        self._sessions = tuple(self._sessions_of(report.routers))
        self._hub_routers = tuple(
            ends
            for port, session, _ in self._sessions
            if port is None and session.whatami == "router"
            for ends in all_ends_of(session)
        )
        if graph is not None:
            self._nodes = graph.nodes
            self._left_out = report.tokens_left_out + graph.left_out

    def is_up(self, link: Link) -> bool:
        """Whether the routers run, and the hub has a session with the peer of a link."""
        return not self._process.failure and is_linked(
            link.peer, link.addresses, self._hub_routers, self._settings.zenoh_listen
        )

    @property
    def container_sessions(self) -> list[tuple[int, str]]:
        """The port and the address of each session with a container."""
        return [(port, ends.remote.host) for port, _, ends in self._sessions if port is not None]

    def inside_names(self) -> list[InsideName]:
        """The topics and services of the nodes with a session at a port for containers."""
        place_by_zid = {s.peer: (port, ends.remote.host) for port, s, ends in self._sessions}
        names: list[InsideName] = []
        for node in self._nodes:
            port, address = place_by_zid.get(node.session, (None, ""))
            if port is None:
                continue
            for kind, of_kind in (
                (RuleKind.PUBLISH, node.publishes),
                (RuleKind.SUBSCRIBE, node.subscribes),
                (RuleKind.SERVE, node.services),
                (RuleKind.CALL, node.calls),
            ):
                names += [InsideName(port, address, node.name, kind, name) for name in of_kind]
        return names

    def status(self) -> ZenohStatus:
        """The part of the status."""
        failure = self._process.failure
        sessions = () if failure else self._sessions
        nodes = () if failure else self._nodes
        host_by_zid = {session.peer: ends.remote.host for _, session, ends in sessions}
        return ZenohStatus(
            ports=str(self._settings.zenoh_ports),
            listen=self._settings.zenoh_listen,
            failure=failure,
            restarts=self._process.restarts,
            links=tuple(map(self._link, self.links)),
            sessions=tuple(
                ZenohSessionStatus(
                    port, session.whatami, session.peer, str(ends.local), str(ends.remote)
                )
                for port, session, ends in sessions
            ),
            nodes=tuple(
                ZenohNodeStatus(
                    node.name,
                    node.domain,
                    host_by_zid.get(node.session, ""),
                    node.publishes,
                    node.subscribes,
                    node.services,
                )
                for node in nodes
            ),
            left_out=0 if failure else self._left_out,
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
                links.add_metric([link.peer], float(link.up))
        hubs = GaugeMetricFamily(
            "rosproxy_zenoh_hubs_up",
            "Proxies on other hosts to which the hub is linked.",
            sum(1 for link in status.links if link.hub and link.up),
        )
        sessions = GaugeMetricFamily(
            "rosproxy_zenoh_sessions", "Sessions of the zenoh routers by mode.", labels=["mode"]
        )
        modes = Counter(session.mode for session in status.sessions)
        for mode in MODES:
            sessions.add_metric([mode], modes[mode])
        nodes = GaugeMetricFamily(
            "rosproxy_zenoh_nodes", "Nodes of rmw_zenoh by side.", labels=["side"]
        )
        inside = sum(1 for node in status.nodes if node.address)
        nodes.add_metric(["inside"], inside)
        nodes.add_metric(["outside"], len(status.nodes) - inside)
        yield from (links, hubs, sessions, nodes)

    def _sessions_of(self, routers: Sequence[RouterReport]) -> Iterator[_PlacedSession]:
        """The sessions with programs other than the routers themselves."""
        own = {router.zid for router in routers}
        ports = [*self._settings.zenoh_ports.ports(), None]
        for port, router in zip(ports, routers, strict=False):
            for session in router.sessions:
                ends = ends_of(session)
                if ends and session.peer not in own:
                    yield port, session, ends

    def _link(self, link: Link) -> ZenohLinkStatus:
        return ZenohLinkStatus(
            peer=str(link.peer),
            up=link.fault is None,
            error=link.fault.value if link.fault else "",
            since=round(max(self._now() - link.since, 0.0), 1),
            hub=link.is_hub,
        )
