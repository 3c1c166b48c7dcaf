"""Leases: the ports of the range, which the proxy reserves from the start.

A port listens only while it is a lease or a fast port of an endpoint, or while it is lent.

Each endpoint holds a *lease*, which is a port of the range. An endpoint may also have a *fast port*
for its topics, which the kernel forwards where possible (`rosproxy.forwarding.fast_ports`). Both
ports listen, and the proxy serves both in the same way. The proxy reserves all ports at the start
(`rosproxy.shared.connections.sockets.reserve`). So the kernel gives no port of the range to an
outgoing connection, no other program binds one, and the proxy learns which ports are taken. A
reserved port refuses connections.
"""

import logging
import socket
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import asynccontextmanager
from typing import Protocol

from rosproxy.binding import PORTS
from rosproxy.forwarding import fast_ports
from rosproxy.forwarding.kernel.syncer import ForwardSyncer
from rosproxy.ros1.context import Context
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.shared.connections.sockets import Acceptor, Handler, listen_on, reserve

log = logging.getLogger(__name__)


class LeaseServer(Protocol):
    """Answers connections to the ports of an endpoint."""

    async def serve(self, endpoint: Endpoint, conn: socket.socket, peer: str, /) -> None:
        """Serve a connection from the address ``peer``."""

    def end_calls(self, port: int, /) -> None:
        """End the XML-RPC connections of a port, which refuses connections from now on.

        A busy connection ends after the current call.
        """


class Leases:
    """Opens, closes and lends the ports of the range.

    ``server`` answers connections. The server itself needs the leases, to close the port of a dead
    node. So ``server`` is set when both exist, before the first port opens. ``watch`` makes the
    resubscriber look at endpoints whose subscribers may have lost connections.
    """

    server: LeaseServer

    def __init__(
        self, context: Context, kernel: ForwardSyncer, watch: Callable[[Iterable[Endpoint]], None]
    ) -> None:
        self._context = context
        self._registry = context.registry
        self._pool = context.registry.pool
        self._kernel = kernel
        self.watch = watch
        self._problems = context.problems
        self._reserved: dict[int, socket.socket] = {}
        self._acceptors: dict[int, Acceptor] = {}
        self._lent: set[int] = set()
        self._closed = False

    def reserve_range(self) -> list[int]:
        """Bind all ports of the range; return the ports that other programs hold."""
        taken = [port for port in self._pool.range.ports() if not self._reserve(port)]
        for port in taken:
            self._pool.block(port)
        return taken

    async def retry_blocked(self) -> None:
        """Reserve the ports of the range that other programs have released."""
        blocked = sorted(self._pool.blocked)
        for port in filter(self._reserve, blocked):
            self._pool.unblock(port)
            log.info("port %d of the range is free now", port)
        if blocked and not self._pool.blocked:
            self._problems.solved(PORTS)

    def is_open(self, endpoint: Endpoint) -> bool:
        """Whether the port of an endpoint listens."""
        return endpoint.port in self._acceptors

    def open(self, endpoint: Endpoint) -> OSError | None:
        """Make the ports of an endpoint listen, if it holds the lease.

        Return the error if the lease can't listen. If only the fast port can't, the endpoint loses
        the fast port, and the result is None.
        """
        if self._closed or self._registry.by_port.get(endpoint.port) is not endpoint:
            return None
        self._kernel.note_change(endpoint)
        if error := self._listen(endpoint, endpoint.port):
            text = f"port {endpoint.port} can't be opened: {error}"
            self._problems.add(endpoint.label, text, endpoint.port)
            log.error("port %d of %s can't be opened: %s", endpoint.port, endpoint.label, error)
        elif endpoint.fast_port is not None and self._listen(endpoint, endpoint.fast_port):
            fast_ports.give_back(self._pool, endpoint, blocked=True)
        return error

    def close(self, endpoint: Endpoint) -> None:
        """Make the ports of an endpoint refuse connections, and end XML-RPC connections.

        Open connections of topics and services stay. If the endpoint no longer holds the lease,
        nothing happens: another node may have the port, because the code that calls `close` may
        have awaited something since it looked up the endpoint.
        """
        if self._registry.by_port.get(endpoint.port) is not endpoint:
            return
        self._kernel.note_change(endpoint)
        for port in (endpoint.port, endpoint.fast_port):
            self._refuse(port)

    def end(self, endpoint: Endpoint) -> None:
        """End a lease: close the port and forget the endpoint."""
        if self._registry.by_port.get(endpoint.port) is endpoint:
            self.close(endpoint)
            self._problems.solved_at(endpoint.port)
            fast_ports.give_back(self._pool, endpoint)
            self._registry.remove(endpoint)

    def close_all(self) -> None:
        """Close and release all ports for good, except lent ports.

        A lent port stays until its `lend` ends. Endpoints and registrations stay.
        """
        self._closed = True
        for endpoint in self._registry:
            self.close(endpoint)
        for sock in self._reserved.values():
            sock.close()
        self._reserved.clear()

    def give_up_spare(self) -> bool:
        """Take back a port that no node needs (lent or fast); return whether there was one."""
        if self._lent:
            self._take_back(next(iter(self._lent)))
            return True
        return self._withdraw_least_used_fast_port() is not None

    def withdraw_fast_port(self, endpoint: Endpoint) -> None:
        """Take back the fast port of an endpoint, so that its topics use the lease."""
        port = endpoint.fast_port
        self._refuse(port)
        fast_ports.give_back(self._pool, endpoint)
        self._kernel.note_change(endpoint)
        self.watch([endpoint])

    def end_idle(self) -> bool:
        """End the lease that has been unused for longest; return whether there was one."""
        oldest = self._registry.longest_idle()
        if oldest is not None:
            self.end(oldest)
        return oldest is not None

    async def wait_until_unforwarded(self, endpoint: Endpoint) -> None:
        """Wait until the kernel no longer forwards a new lease that was a fast port.

        Waits for FORWARD_TIMEOUT_S at most (`ForwardSyncer.wait_until_unforwarded`).
        """
        await self._kernel.wait_until_unforwarded(endpoint.port)

    async def obtain_fast_port(self, endpoint: Endpoint, node_port: int) -> int | None:
        """Return the port that the kernel forwards to a TCPROS port of the node; None if none.

        An endpoint without a fast port first gets the partner of its lease, if the partner is free
        (`fast_ports.claim`).
        """
        if self._kernel.may_forward(endpoint):
            if endpoint.fast_port is None and fast_ports.claim(self._pool, endpoint):
                self.open(endpoint)
            if endpoint.fast_port and await self._kernel.forwards(endpoint, node_port):
                return endpoint.fast_port
        self._kernel.log_reason(endpoint)
        return None

    @asynccontextmanager
    async def lend(
        self, order: Iterable[int], handler: Handler, or_fast: bool
    ) -> AsyncIterator[int | None]:
        """Lend a port that no node needs, and serve it by a handler; None if none is free.

        The port is the first free port in ``order``. If there is none, ``or_fast`` allows a fast
        port; its holder gets a fast port again when a subscriber next asks. If a node needs the
        port, the proxy takes the port back (`is_lent`). Raises OSError if another program has taken
        the port.
        """
        port = next(filter(self._pool.claim, order), None)
        if port is None and or_fast:
            spare = self._withdraw_least_used_fast_port()
            port = spare if spare is not None and self._pool.claim(spare) else None
        if port is None:
            yield None
            return
        self._lent.add(port)
        try:
            await self._kernel.wait_until_unforwarded(port)
            if port in self._lent:  # otherwise a node has needed the port meanwhile
                self._accept(port, handler)
            yield port
        finally:
            self._take_back(port)

    def is_lent(self, port: int) -> bool:
        """Whether a port is still lent."""
        return port in self._lent

    def _take_back(self, port: int) -> None:
        if port in self._lent:
            self._lent.remove(port)
            self._refuse(port)
            self._pool.give_back(port)

    def _reserve(self, port: int) -> bool:
        """Bind a port, which then refuses; False if that fails, or after `close_all`."""
        if self._closed:
            return False
        try:
            self._reserved[port] = reserve(self._context.settings.bind, port)
        except OSError as error:
            log.debug("port %d can't be reserved: %s", port, error)
            return False
        return True

    def _accept(self, port: int, handler: Handler) -> None:
        """Make a port listen. Raises OSError if another program has taken the port."""
        sock = self._reserved.pop(port, None) or reserve(self._context.settings.bind, port)
        try:
            listen_on(sock)
        except OSError:
            sock.close()
            raise
        self._acceptors[port] = Acceptor(self._context.tasks, sock, handler, self._context.gate)

    def _listen(self, endpoint: Endpoint, port: int) -> OSError | None:
        """Make a port listen for an endpoint; the error if that fails."""
        if port not in self._acceptors:
            try:
                self._accept(port, lambda conn, peer: self.server.serve(endpoint, conn, peer))
            except OSError as error:
                return error
        return None

    def _refuse(self, port: int | None) -> None:
        """Stop listening, and keep the port reserved."""
        acceptor = self._acceptors.pop(port, None) if port is not None else None
        if acceptor is not None and port is not None:
            acceptor.close()
            self.server.end_calls(port)
            # If another program binds the port first, `_accept` tries again when a node next needs
            # the port.
            self._reserve(port)

    def _withdraw_least_used_fast_port(self) -> int | None:
        """Withdraw the least used fast port, and return it; None if there is none."""
        holder = fast_ports.least_used_holder(self._registry)
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
