"""Nodes outside as those inside reach them through a stand-in: asked, connected to, refusing.

Nothing leads to the proxy itself or to inside: whoever writes to the master names the addresses.
Nodes of outside may run beside the proxy, though: at an address of its own machine only the proxy's
own ports are refused. Loopback is everywhere, as it means another machine to whoever gave it.
"""

import logging
import socket
from collections.abc import Callable
from dataclasses import dataclass

from rosproxy.access.rules import RuleKind
from rosproxy.net import sockets
from rosproxy.net.addresses import HostPort, is_inside, is_loopback
from rosproxy.net.interfaces import is_own
from rosproxy.net.resolver import NODES, resolve
from rosproxy.ros1.clients.master import MasterError, Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.uris import parse_service_uri, path_of
from rosproxy.ros1.registry.health import ProbeResult
from rosproxy.ros1.registry.stand_ins import StandIn
from rosproxy.ros1.servers.access_checks import AccessChecks

log = logging.getLogger(__name__)

CONNECT_TIMEOUT = 2.0
LOOK_TIMEOUT = 1.0
"""Seconds for which a node waits at most for the URI of another one that was gone."""


class Outside:
    """Reaches nodes outside. ``note_refused`` is told of one that refuses: it has ended."""

    def __init__(self, context: Context, note_refused: Callable[[StandIn], None]) -> None:
        self._context, self._note_refused = context, note_refused

    async def refuses(self, uri: str, where: HostPort) -> bool:
        """Whether nobody listens for the URI of a node outside, or of a service there.

        A node is asked something: roslisp ends if it is connected to and then told nothing.
        """
        try:
            reached = await self.reach(where)
            if not parse_service_uri(uri):
                answer = await self._context.nodes.probe(reached, LOOK_TIMEOUT)
                return answer.probe is ProbeResult.REFUSED
            (await sockets.dial(reached, LOOK_TIMEOUT)).close()
        except ConnectionRefusedError:
            return True
        except OSError as error:
            log.debug("%s: %s", where, error)
        return False

    async def ask(self, stand_in: StandIn, body: bytes, path: str) -> bytes:
        """The answer of a node outside to a call to a path. Raises Unreachable."""
        path = path if stand_in.kept else path_of(stand_in.uri)
        try:
            await self.reach(stand_in.where)
            return await self._context.upstream.post_to_node(stand_in.where, body, path=path)
        except OSError as error:
            if isinstance(error, ConnectionRefusedError):
                self._note_refused(stand_in)
            raise Unreachable(f"node at {stand_in.where}: {error}") from None
        except Unreachable as error:
            if error.refused:
                self._note_refused(stand_in)
            raise

    async def ask_topic_port(self, stand_in: StandIn, topic: str) -> int | None:
        """The TCPROS port that a node outside names for a topic; None if it names none."""
        try:
            where = await self.reach(stand_in.where)
            port = await self._context.nodes.topic_port(where, topic)
        except (OSError, Unreachable, MasterError) as error:
            log.debug("%s gives no TCPROS port for %s: %s", stand_in.uri, topic, error)
            return None
        if port is not None:
            stand_in.note_topic_port(topic, port)
        return port

    async def connect(self, stand_in: StandIn, port: int | None) -> socket.socket | None:
        """A connection to a TCPROS port of a node outside; None if there is none."""
        if port is None:
            return None
        where = HostPort(stand_in.where.host, port)
        try:
            return await self._dial(where, CONNECT_TIMEOUT)
        except OSError as error:  # a time-out is one, too
            log.debug("%s: %s", where, error)
            if isinstance(error, ConnectionRefusedError) and where == stand_in.where:
                self._note_refused(stand_in)
            return None

    async def _dial(self, where: HostPort, within: float) -> socket.socket:
        """Connect to a port outside; refused where that leads back or inside. Raises OSError."""
        return await sockets.dial(await self.reach(where), within)

    async def reach(self, where: HostPort) -> HostPort:
        """Where a host and port of outside are. Raises OSError: refused if that is not outside."""
        reached = self._context.upstream.reach(where)
        found = await resolve(reached.host, NODES)
        if not found:
            raise OSError(f"{where.host} can't be resolved")
        outside = [one for one in found if not self._leads_back(HostPort(one, reached.port))]
        if not outside:
            raise ConnectionRefusedError(f"{', '.join(found)} port {where.port} is not outside")
        return HostPort(outside[0], where.port)

    def _leads_back(self, where: HostPort) -> bool:
        """Whether an address and port are inside, or the proxy's own."""
        stand_ins, address = self._context.stand_ins, where.host
        inside = stand_ins.both and is_inside(address, self._context.addressing.networks)
        if inside or is_loopback(address):
            return True
        return is_own(address) and stand_ins.is_proxys(where.port)


@dataclass(slots=True)
class OutsideNode:
    """A node outside as a target of TCPROS, for those who connect from inside."""

    _outside: Outside
    _context: Context
    _access: AccessChecks
    _stand_in: StandIn
    inside: bool = False

    @property
    def port(self) -> int:
        """The port that stands in for it."""
        return self._stand_in.local.port

    def why_not(self, kind: str, name: str, peer: str, caller_id: str) -> str | None:
        """Why a node inside may not have a topic or service; None if it may."""
        asked = RuleKind.CALL if kind == "service" else RuleKind.SUBSCRIBE
        return self._access.inside_may_not(asked, name, peer, caller_id)

    async def connect(self, kind: str, name: str) -> socket.socket | None:
        """A connection to the node; its port for a topic is asked for anew if the known refuses."""
        outside, stand_in = self._outside, self._stand_in
        serves = parse_service_uri(stand_in.uri) is not None
        if stand_in.kept or (serves and kind == "service"):
            return await outside.connect(stand_in, stand_in.where.port)
        if serves or kind == "service":
            return None
        node = await outside.connect(stand_in, stand_in.topic_ports.get(name))
        return node or await outside.connect(stand_in, await outside.ask_topic_port(stand_in, name))

    def label(self, kind: str, name: str) -> str:
        """The topic if the node has named a port for it; for anything else its URI."""
        return name if name in self._stand_in.topic_ports else self._stand_in.uri

    def note_connection(self) -> None:
        """Nothing to note: whether a stand-in is in use is counted by its relays."""

    def note_disconnection(self) -> None:
        """Note that it was of use until now."""
        self._context.stand_ins.note_used(self._stand_in)

    def note_failure(self, name: str) -> None:
        """Nothing to note: a node outside that is gone is the master's to tell."""
