"""Who listens: the ports of the range, reserved from the start and listening only while leased.

Each endpoint holds a *lease*, one port of the range, and maybe a *fast port* for its topics, which
the kernel forwards where it may (`fast_ports`). Both listen and are served alike. All ports are
reserved at the start (`rosproxy.net.sockets.reserve`): that keeps the kernel from giving one of
them to an outgoing connection and other programs from binding it, and tells which are taken. A
reserved port refuses.

What an endpoint is, who serves it and how the kernel forwards is left to the protocols below.
"""

import logging
import socket
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import asynccontextmanager
from typing import Generic, Protocol, TypeVar

from rosproxy.leases import fast_ports
from rosproxy.leases.fast_ports import LeaseHolder, LeaseHolders
from rosproxy.net.gate import Gate
from rosproxy.net.sockets import Acceptor, Handler, listen_on, reserve
from rosproxy.net.tasks import Tasks
from rosproxy.telemetry.problems import Problems

log = logging.getLogger(__name__)

RANGE_OPTION = "--port-range"
PORTS = "ports"
"""The subject of problems with the range."""
_H = TypeVar("_H", bound=LeaseHolder)
_H_contra = TypeVar("_H_contra", bound=LeaseHolder, contravariant=True)


class LeaseBook(LeaseHolders[_H], Protocol[_H]):
    """All endpoints, to be kept in step with what listens."""

    def remove(self, endpoint: _H, /) -> None:
        """Forget an endpoint and give its lease back."""

    def longest_idle(self) -> _H | None:
        """The endpoint to give up first when the range is short."""


class HolderServer(Protocol[_H_contra]):
    """Answers connections to an endpoint's ports."""

    async def serve(self, endpoint: _H_contra, conn: socket.socket, peer: str, /) -> None:
        """Serve a connection; ``peer`` is the address it comes from."""

    def end_calls(self, port: int, /) -> None:
        """Let what is kept open through a port end: it refuses from now on."""


class KernelPorts(Protocol):
    """What the kernel forwards; see `rosproxy.forwarding.kernel.syncer`."""

    def note_change(self, endpoint: LeaseHolder, /) -> None:
        """Note that an endpoint's ports or its node have changed."""

    def may_forward(self, endpoint: LeaseHolder, /) -> bool:
        """Whether an endpoint's topics could be forwarded if it had a fast port."""

    async def forwards(self, endpoint: LeaseHolder, node_port: int, /) -> bool:
        """Whether an endpoint's fast port leads to a TCPROS port; waits a moment."""

    async def cleared(self, port: int, /) -> None:
        """Wait a moment until a port is not forwarded any more."""

    def log_reason(self, endpoint: LeaseHolder, /) -> None:
        """Log why an endpoint's topics are not forwarded."""


class Leases(Generic[_H]):
    """Opens, closes and lends the ports of the range, which are bound at ``address``.

    ``server`` answers what comes in. It needs the leases itself (a node that is found dead has its
    port closed), so that it is set once both are there, before the first port opens. ``watch``
    looks after subscribers of endpoints, whose connections may be lost.
    ``gate`` counts connections.
    """

    server: HolderServer[_H]

    def __init__(
        self,
        holders: LeaseBook[_H],
        address: str,
        kernel: KernelPorts,
        watch: Callable[[Iterable[_H]], None],
        tasks: Tasks,
        problems: Problems,
        gate: Gate,
    ) -> None:
        self._gate = gate
        self._holders = holders
        self._address = address
        self._kernel = kernel
        self.watch = watch
        self._tasks = tasks
        self._problems = problems
        self._reserved: dict[int, socket.socket] = {}
        self._acceptors: dict[int, Acceptor] = {}
        self._lent: set[int] = set()
        self._closed = False

    def reserve_range(self) -> list[int]:
        """Bind all ports of the range; returns those that other programs hold."""
        taken = [port for port in self._holders.pool.range.ports() if not self._reserve(port)]
        for port in taken:
            self._holders.pool.block(port)
        return taken

    async def retry_blocked(self) -> None:
        """Take in ports of the range that other programs have let go."""
        pool = self._holders.pool
        blocked = sorted(pool.blocked)
        for port in filter(self._reserve, blocked):
            pool.unblock(port)
            log.info("port %d of the range is free now", port)
        if blocked and not pool.blocked:
            self._problems.solved(PORTS)

    def is_open(self, endpoint: _H) -> bool:
        """Whether an endpoint's port listens."""
        return endpoint.port in self._acceptors

    def open(self, endpoint: _H) -> OSError | None:
        """Let an endpoint's ports listen, if it still holds the lease; the error if it fails."""
        if self._closed or self._holders.by_port.get(endpoint.port) is not endpoint:
            return None
        self._kernel.note_change(endpoint)
        if error := self._listen(endpoint, endpoint.port):
            text = f"port {endpoint.port} can't be opened: {error}"
            self._problems.add(endpoint.label, text, endpoint.port)
            log.error("port %d of %s can't be opened: %s", endpoint.port, endpoint.label, error)
        elif endpoint.fast_port is not None and self._listen(endpoint, endpoint.fast_port):
            fast_ports.give_back(self._holders.pool, endpoint, blocked=True)
        return error

    def close(self, endpoint: _H) -> None:
        """Let an endpoint's ports refuse, if it still holds the lease; open connections stay.

        The port may be another node's by now: callers may have waited for something meanwhile.
        """
        if self._holders.by_port.get(endpoint.port) is not endpoint:
            return
        self._kernel.note_change(endpoint)
        for port in (endpoint.port, endpoint.fast_port):
            self._refuse(port)

    def end(self, endpoint: _H) -> None:
        """End a lease: close its port and forget its endpoint."""
        if self._holders.by_port.get(endpoint.port) is endpoint:
            self.close(endpoint)
            self._problems.solved_at(endpoint.port)
            fast_ports.give_back(self._holders.pool, endpoint)
            self._holders.remove(endpoint)

    def close_all(self) -> None:
        """Close all ports and give the range back, for good; endpoints and registrations stay."""
        self._closed = True
        for endpoint in self._holders:
            self.close(endpoint)
        for sock in self._reserved.values():
            sock.close()
        self._reserved.clear()

    def give_up_spare(self) -> bool:
        """Take a port back that no node needs, if there is one: a lent one, or a fast port."""
        if self._lent:
            self._take_back(next(iter(self._lent)))
            return True
        return self._give_fast_port_back() is not None

    def withdraw_fast_port(self, endpoint: _H) -> None:
        """Take the fast port of an endpoint back: its topics have to go through the lease."""
        port = endpoint.fast_port
        self._refuse(port)
        fast_ports.give_back(self._holders.pool, endpoint)
        self._kernel.note_change(endpoint)
        self.watch([endpoint])

    def end_idle(self) -> bool:
        """End the lease that is needed least, if nobody needs it."""
        oldest = self._holders.longest_idle()
        if oldest is not None:
            self.end(oldest)
        return oldest is not None

    async def cleared(self, endpoint: _H) -> None:
        """Wait a moment until the kernel no longer forwards a new lease, which was a fast port."""
        await self._kernel.cleared(endpoint.port)

    async def fast_port(self, endpoint: _H, node_port: int) -> int | None:
        """The port that the kernel forwards to a TCPROS port of an endpoint's node; None if none.

        It is handed out when a subscriber first asks for a topic, while the range has ports left.
        """
        if self._kernel.may_forward(endpoint):
            if endpoint.fast_port is None and fast_ports.claim(self._holders.pool, endpoint):
                self.open(endpoint)
            if endpoint.fast_port and await self._kernel.forwards(endpoint, node_port):
                return endpoint.fast_port
        self._kernel.log_reason(endpoint)
        return None

    @asynccontextmanager
    async def lent(
        self, order: Iterable[int], handler: Handler, or_fast: bool
    ) -> AsyncIterator[int | None]:
        """A port that no node needs meanwhile, on which a handler serves; None if there is none.

        It is the first in an order that is free, with ``or_fast`` else a fast port, whose holder
        gets it again when a subscriber next asks. It is taken back where a node needs it
        (`is_lent`). Raises OSError if another program took it meanwhile.
        """
        pool = self._holders.pool
        port = next(filter(pool.claim, order), None)
        if port is None and or_fast:
            spare = self._give_fast_port_back()
            port = spare if spare is not None and pool.claim(spare) else None
        if port is None:
            yield None
            return
        self._lent.add(port)
        try:
            await self._kernel.cleared(port)
            if port in self._lent:  # a node may have needed it meanwhile
                self._accept(port, handler)
            yield port
        finally:
            self._take_back(port)

    def is_lent(self, port: int) -> bool:
        """Whether a port that was lent still is."""
        return port in self._lent

    def _take_back(self, port: int) -> None:
        if port in self._lent:
            self._lent.remove(port)
            self._refuse(port)
            self._holders.pool.give_back(port)

    def _reserve(self, port: int) -> bool:
        """Bind a port, which then refuses; False if another program holds it, or all is over."""
        if self._closed:
            return False
        try:
            self._reserved[port] = reserve(self._address, port)
        except OSError as error:
            log.debug("port %d can't be reserved: %s", port, error)
            return False
        return True

    def _accept(self, port: int, handler: Handler) -> None:
        """Let a port listen. Raises OSError if another program took it meanwhile."""
        sock = self._reserved.pop(port, None) or reserve(self._address, port)
        try:
            listen_on(sock)
        except OSError:
            sock.close()
            raise
        self._acceptors[port] = Acceptor(self._tasks, sock, handler, self._gate)

    def _listen(self, endpoint: _H, port: int) -> OSError | None:
        """Let a port listen for an endpoint; the error if that fails."""
        if port not in self._acceptors:
            try:
                self._accept(port, lambda conn, peer: self.server.serve(endpoint, conn, peer))
            except OSError as error:
                return error
        return None

    def _refuse(self, port: int | None) -> None:
        """Stop listening and keep the port reserved."""
        acceptor = self._acceptors.pop(port, None) if port is not None else None
        if acceptor is not None and port is not None:
            acceptor.close()
            self.server.end_calls(port)
            # If another program is quicker, `_accept` tries again when the port is next needed.
            self._reserve(port)

    def _give_fast_port_back(self) -> int | None:
        """Give back the fast port that is needed least, and tell which it was; None: none left."""
        holder = fast_ports.least_used_holder(self._holders)
        if holder is None:
            return None
        port = holder.fast_port
        log.info(
            "%s: the proxy takes fast port %s back, since no other port of the range is free",
            holder.label,
            port,
        )
        self.withdraw_fast_port(holder)
        return port
