"""How nodes inside reach nodes outside through a stand-in: by slave API calls and by TCPROS.

No connection may lead to the proxy itself, because any program can write addresses to the master.
With ``--direction both`` no connection may lead to inside either. Nodes of outside may run on the
proxy's own machine. So at an address of this machine only the proxy's own ports are refused.
Loopback is always refused, because the node that gave a loopback address meant another machine.
"""

import logging
import socket
from collections.abc import Callable
from dataclasses import dataclass

from rosproxy.ros1.clients.master_client import MasterError, Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.policy.denial import Denial
from rosproxy.ros1.registry.node_health import ProbeResult
from rosproxy.ros1.registry.stand_ins import StandIn
from rosproxy.shared.addresses import HostPort, is_inside, is_loopback
from rosproxy.shared.connections import sockets
from rosproxy.shared.machine.interfaces import is_own
from rosproxy.shared.machine.resolver import NODES, resolve
from rosproxy.shared.uris import parse_service_uri, path_of

log = logging.getLogger(__name__)

CONNECT_TIMEOUT_S = 2.0
RETRY_TIMEOUT_S = 1.0
"""Seconds that a node inside waits at most while the proxy tries a node that has refused."""


class Outside:
    """Reaches nodes outside. ``note_refused`` gets the stand-in of a node that has ended."""

    def __init__(self, context: Context, note_refused: Callable[[StandIn], None]) -> None:
        self._context = context
        self._note_refused = note_refused

    async def refuses(self, uri: str, target: HostPort) -> bool:
        """Whether a node or a service outside refuses connections.

        The proxy makes a real call to a node, because roslisp ends after a connection without a
        call.
        """
        try:
            reached = await self.reach(target)
            if not parse_service_uri(uri):
                answer = await self._context.nodes.probe(reached, RETRY_TIMEOUT_S)
                return answer.probe is ProbeResult.REFUSED
            (await sockets.dial(reached, RETRY_TIMEOUT_S)).close()
        except ConnectionRefusedError:
            return True
        except OSError as error:
            log.debug("%s: %s", target, error)
        return False

    async def ask(self, stand_in: StandIn, body: bytes, path: str) -> bytes:
        """Forward a slave API call to a node outside; return its answer. Raises Unreachable."""
        path = path if stand_in.is_uri_kept else path_of(stand_in.uri)
        try:
            # The checked address: a name server may give another address next time.
            reached = await self.reach(stand_in.target)
            name = str(stand_in.target)  # for the Host field
            return await self._context.upstream.post_to_node(reached, body, path=path, name=name)
        except OSError as error:
            if isinstance(error, ConnectionRefusedError):
                self._note_refused(stand_in)
            raise Unreachable(f"node at {stand_in.target}: {error}") from None
        except Unreachable as error:
            if error.refused:
                self._note_refused(stand_in)
            raise

    async def ask_topic_port(self, stand_in: StandIn, topic: str) -> int | None:
        """The TCPROS port that a node outside names for a topic; None if the node names none."""
        try:
            slave = await self.reach(stand_in.target)
            port = await self._context.nodes.topic_port(slave, topic)
        except (OSError, Unreachable, MasterError) as error:
            log.debug("%s gives no TCPROS port for topic %s: %s", stand_in.uri, topic, error)
            return None
        if port is not None:
            stand_in.note_topic_port(topic, port)
        return port

    async def connect(self, stand_in: StandIn, port: int | None) -> socket.socket | None:
        """Connect to a TCPROS port of a node outside; None if that fails."""
        if port is None:
            return None
        target = HostPort(stand_in.target.host, port)
        try:
            return await self._dial(target, CONNECT_TIMEOUT_S)
        except OSError as error:  # a TimeoutError is an OSError
            log.debug("%s: %s", target, error)
            # Only the port of the URI counts: a node that has closed a TCPROS port may live.
            if isinstance(error, ConnectionRefusedError) and target == stand_in.target:
                self._note_refused(stand_in)
            return None

    async def _dial(self, target: HostPort, timeout_s: float) -> socket.socket:
        """Connect to a port outside; refuse targets inside or of the proxy. Raises OSError."""
        return await sockets.dial(await self.reach(target), timeout_s)

    async def reach(self, target: HostPort) -> HostPort:
        """The address and port of a host outside. Raises OSError, also for a host inside.

        A host is not outside if `_leads_back` refuses all its addresses.
        """
        mapped = self._context.upstream.reach(target)
        resolved = await resolve(mapped.host, NODES)
        if not resolved:
            raise OSError(f"host name {target.host} can't be resolved")
        outside = [a for a in resolved if not self._leads_back(HostPort(a, mapped.port))]
        if not outside:
            raise ConnectionRefusedError(f"{', '.join(resolved)} port {target.port} is not outside")
        return HostPort(outside[0], target.port)

    def _leads_back(self, target: HostPort) -> bool:
        """Whether an address and port are on loopback, the proxy's own, or inside.

        Inside counts only with ``--direction both``.
        """
        stand_ins = self._context.stand_ins
        address = target.host
        inside = stand_ins.is_bidirectional and is_inside(
            address, self._context.addressing.networks
        )
        if inside or is_loopback(address):
            return True
        return is_own(address) and stand_ins.is_own_port(target.port)


@dataclass(slots=True)
class OutsideNode:
    """A node outside as the target of TCPROS connections from inside."""

    _outside: Outside
    _context: Context
    _stand_in: StandIn
    inside: bool = False

    @property
    def port(self) -> int:
        """The port of the stand-in."""
        return self._stand_in.local.port

    def check(self, kind: str, name: str, peer: str, caller_id: str) -> Denial | None:
        """Check whether a node inside may have a topic or service."""
        return self._context.policy.check_inside(kind, name, peer, caller_id)

    async def connect(self, kind: str, name: str) -> socket.socket | None:
        """Connect to the node; ask for its port again if the known port refuses.

        None if that fails. Also None if a client asks a service for a topic, or a node for a
        service.
        """
        outside = self._outside
        stand_in = self._stand_in
        is_service = parse_service_uri(stand_in.uri) is not None
        if stand_in.is_uri_kept or (is_service and kind == "service"):
            return await outside.connect(stand_in, stand_in.target.port)
        if is_service or kind == "service":
            return None
        node = await outside.connect(stand_in, stand_in.topic_ports.get(name))
        return node or await outside.connect(stand_in, await outside.ask_topic_port(stand_in, name))

    def label(self, kind: str, name: str) -> str:
        """The topic if the node has named a port for it, otherwise the URI."""
        return name if name in self._stand_in.topic_ports else self._stand_in.uri

    def note_connection(self) -> None:
        """Record nothing: the relays of a stand-in tell whether it is in use."""

    def note_disconnection(self) -> None:
        """Record that the stand-in was in use until now."""
        self._context.stand_ins.note_used(self._stand_in)

    def note_failure(self, name: str) -> None:
        """Record nothing: the master decides whether a node outside is gone."""
