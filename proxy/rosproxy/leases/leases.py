"""Who listens: the ports of the range, bound from the start and listening only while leased.

Each endpoint holds a *lease*, one port of the range, and maybe a *fast port* for its topics, which
the kernel forwards where it may (`fast_ports`). Both listen and are served alike. All ports are
bound at the start: that keeps the kernel from giving one of them to an outgoing connection, and
tells which are taken. A bound port that does not listen refuses.

What an endpoint is, who serves it and how the kernel forwards is left to the protocols below.
"""

import logging
import socket
from collections.abc import AsyncIterator, Iterable, Iterator, Mapping
from contextlib import asynccontextmanager
from typing import Generic, Protocol, TypeVar

from rosproxy.leases import fast_ports
from rosproxy.leases.fast_ports import Holder
from rosproxy.leases.ports import PortPool
from rosproxy.net.acceptor import Acceptor
from rosproxy.net.sockets import BACKLOG, bind
from rosproxy.net.tasks import Tasks
from rosproxy.telemetry.problems import Problems

log = logging.getLogger(__name__)

RANGE_OPTION = "--port-range"
_H = TypeVar("_H", bound=Holder)
_H_contra = TypeVar("_H_contra", bound=Holder, contravariant=True)


class Holders(Protocol[_H]):
    """All endpoints, and the range that their ports are of."""

    @property
    def pool(self) -> PortPool:
        """The ports of the range."""

    @property
    def by_port(self) -> Mapping[int, _H]:
        """The endpoints by their leases."""

    def __iter__(self) -> Iterator[_H]:
        """All endpoints; safe against changes while iterating."""

    def remove(self, endpoint: _H, /) -> None:
        """Forget an endpoint and give its lease back."""

    def reclaimable(self) -> _H | None:
        """The endpoint to give up first when the range is short."""


class HolderServer(Protocol[_H_contra]):
    """Answers connections to an endpoint's ports."""

    async def serve(self, endpoint: _H_contra, conn: socket.socket, peer: str, /) -> None:
        """Serve a connection; ``peer`` is the address it comes from."""

    def end_calls(self, port: int, /) -> None:
        """Let what is kept open through a port end: it refuses from now on."""


class KernelPorts(Protocol[_H_contra]):
    """What the kernel forwards; see `rosproxy.forwarding.kernel`."""

    def note_change(self, endpoint: _H_contra, /) -> None:
        """Note that an endpoint's ports or its node have changed."""

    def may_forward(self, endpoint: _H_contra, /) -> bool:
        """Whether an endpoint's topics could be forwarded if it had a fast port."""

    async def forwards(self, endpoint: _H_contra, tcpros_port: int, /) -> bool:
        """Whether an endpoint's fast port leads to a TCPROS port; waits a moment."""

    async def cleared(self, port: int, /) -> None:
        """Wait a moment until a port is not forwarded any more."""

    def log_reason(self, endpoint: _H_contra, /) -> None:
        """Log why an endpoint's topics are not forwarded."""


class Watcher(Protocol[_H_contra]):
    """Looks after subscribers whose connections may be lost."""

    def watch(self, endpoints: Iterable[_H_contra], /) -> None:
        """Look after the subscribers of some endpoints for a while."""


class PortBank:
    """Sockets bound to the ports of a range."""

    def __init__(self, address: str) -> None:
        self._address = address
        self._bound: dict[int, socket.socket] = {}

    def reserve(self, ports: Iterable[int]) -> list[int]:
        """Bind all ports; returns those that another program holds."""
        return [port for port in ports if not self._reserve(port)]

    def open(self, port: int) -> socket.socket:
        """Let a reserved port listen. Raises OSError if another program took it meanwhile."""
        sock = self._bound.pop(port, None) or bind(self._address, port)
        try:
            sock.listen(BACKLOG)
        except OSError:
            sock.close()
            raise
        return sock

    def close(self, port: int, sock: socket.socket) -> None:
        """Stop listening and keep the port reserved."""
        sock.close()
        self._reserve(port)

    def close_all(self) -> None:
        """Give all reserved ports back."""
        for sock in self._bound.values():
            sock.close()
        self._bound.clear()

    def _reserve(self, port: int) -> bool:
        try:
            self._bound[port] = bind(self._address, port)
        except OSError as error:
            log.debug("port %d can't be reserved: %s", port, error)
            return False
        return True


class Leases(Generic[_H]):
    """Opens, closes and lends the ports of the range.

    ``server`` answers what comes in. It needs the leases itself (a node that is found dead has its
    port closed), so that it is set once both are there, before the first port opens.
    """

    server: HolderServer[_H]

    def __init__(
        self,
        holders: Holders[_H],
        bank: PortBank,
        kernel: KernelPorts[_H],
        watcher: Watcher[_H],
        tasks: Tasks,
        problems: Problems,
    ) -> None:
        self.bank = bank
        self._holders, self._kernel, self._watcher = holders, kernel, watcher
        self._tasks, self._problems = tasks, problems
        self._acceptors: dict[int, Acceptor] = {}

    def reserve_range(self) -> list[int]:
        """Bind all ports of the range; returns those that other programs hold."""
        taken = self.bank.reserve(self._holders.pool.range.ports())
        for port in taken:
            self._holders.pool.block(port)
        return taken

    async def retry_blocked(self) -> None:
        """Take in ports of the range that other programs have let go."""
        pool = self._holders.pool
        before = pool.blocked_ports
        still = self.bank.reserve(before)
        for port in set(before) - set(still):
            pool.unblock(port)
            log.info("port %d of the range is free now", port)
        if before and not still:
            self._problems.solved(RANGE_OPTION)

    def is_open(self, endpoint: _H) -> bool:
        """Whether an endpoint's port listens."""
        return endpoint.port in self._acceptors

    def open(self, endpoint: _H) -> None:
        """Let an endpoint's ports listen, if it still holds the lease."""
        if self._holders.by_port.get(endpoint.port) is not endpoint:
            return
        self._kernel.note_change(endpoint)
        if error := self._listen(endpoint, endpoint.port):
            text = f"port {endpoint.port} is taken: {error}"
            self._problems.add(endpoint.label, text, endpoint.port)
            log.error("port %d of %s can't be opened: %s", endpoint.port, endpoint.label, error)
        elif endpoint.fast_port is not None and self._listen(endpoint, endpoint.fast_port):
            fast_ports.give_back(self._holders.pool, endpoint, blocked=True)

    def close(self, endpoint: _H) -> None:
        """Let an endpoint's ports refuse; the lease and open connections stay."""
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
        """Close all ports and give the range back; endpoints and registrations stay."""
        for endpoint in self._holders:
            self.close(endpoint)
        self.bank.close_all()

    def make_room(self) -> bool:
        """Take a port back that is needed least, if there is one: a fast port, or an idle lease."""
        if self._give_fast_port_back() is not None:
            return True
        oldest = self._holders.reclaimable()
        if oldest is not None:
            self.end(oldest)
        return oldest is not None

    async def cleared(self, endpoint: _H) -> None:
        """Wait a moment until the kernel no longer forwards a new lease, which was a fast port."""
        await self._kernel.cleared(endpoint.port)

    async def fast_port(self, endpoint: _H, tcpros_port: int) -> int | None:
        """The port that the kernel forwards to a TCPROS port of an endpoint's node; None if none.

        It is handed out when a subscriber first asks for a topic, while the range has ports left.
        """
        if self._kernel.may_forward(endpoint):
            if endpoint.fast_port is None and fast_ports.claim(self._holders.pool, endpoint):
                self.open(endpoint)
            if endpoint.fast_port and await self._kernel.forwards(endpoint, tcpros_port):
                return endpoint.fast_port
        self._kernel.log_reason(endpoint)
        return None

    @asynccontextmanager
    async def lent(self, order: Iterable[int]) -> AsyncIterator[int | None]:
        """A port that no node needs meanwhile; None if there is none.

        It is the first in an order that is free, else a fast port: whose that was gets it again
        when a subscriber next asks.
        """
        pool = self._holders.pool
        port = next(filter(pool.claim, order), None)
        if port is None:
            spare = self._give_fast_port_back()
            port = spare if spare is not None and pool.claim(spare) else None
        try:
            if port is not None:
                await self._kernel.cleared(port)
            yield port
        finally:
            if port is not None:
                pool.give_back(port)

    def _listen(self, endpoint: _H, port: int) -> OSError | None:
        """Let a port listen for an endpoint; the error if another program has it."""
        if port in self._acceptors:
            return None
        try:
            sock = self.bank.open(port)
        except OSError as error:
            return error
        self._acceptors[port] = Acceptor(
            self._tasks, sock, lambda conn, peer: self.server.serve(endpoint, conn, peer)
        )
        return None

    def _refuse(self, port: int | None) -> None:
        acceptor = self._acceptors.pop(port, None) if port is not None else None
        if acceptor is not None and port is not None:
            acceptor.stop()
            self.server.end_calls(port)
            self.bank.close(port, acceptor.sock)

    def _give_fast_port_back(self) -> int | None:
        """Give back the fast port that is needed least, and tell which it was; None: none left."""
        holder = fast_ports.to_give_back(self._holders)
        if holder is None:
            return None
        port = holder.fast_port
        self._refuse(port)
        log.info("%s: port %s is needed otherwise", holder.label, port)
        fast_ports.give_back(self._holders.pool, holder)
        self._kernel.note_change(holder)
        self._watcher.watch([holder])
        return port
