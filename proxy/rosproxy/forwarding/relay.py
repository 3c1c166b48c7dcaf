"""Moving bytes between two sockets: one blocking thread per direction.

On Linux bulk data moves by splice(2) through a pipe and never enters Python; messages below some
8 KiB cost the same either way, and copying them needs no pipe. Back-pressure is the kernel's own:
a thread that can't write doesn't read. The GIL is released in every call that blocks.
"""

import contextlib
import fcntl
import logging
import os
import socket
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from rosproxy.net.sockets import reset_on_close

log = logging.getLogger(__name__)

COPY_SIZE = 16 * 1024
"""Bytes read at once while copying; a full read switches the direction to splice.

From here on splice costs less, with the opening of a pipe counted in.
"""
PIPE_SIZE = 1024 * 1024
"""Bytes that a splice pipe should hold; the kernel may give an unprivileged process less."""
LARGE_PIPES = 16
"""Pipes of that size at the same time; with more streams the CPU is busy, and each turn shorter."""
SHARED_PIPE = 256 * 1024
"""Bytes that each further pipe should hold: an unprivileged user has 64 MiB for all of them."""
CROWD = 128
"""Directions that move many bytes at the same time before they have to share memory."""
SHARED_RECEIVE = 128 * 1024
SHARED_SEND = 208 * 1024
"""Bytes of a socket's buffers in a crowd, of which Linux makes twice as much.

Left alone each grows to several MiB; a thousand of them reach the limit of all TCP connections of
the machine (tcp_mem), from where on Linux drops packets and sends by the page. The larger one is
what Linux grants to anyone (wmem_max).
"""
LEAST_PIPE = 64 * 1024
"""A pipe that holds fewer bytes is not spliced through."""
BLOCK_SIZE = 128 * 1024
"""Bytes copied at once where there is no pipe; a buffer to keep would have to be zeroed first."""
RESET_GRACE = 0.1
"""Seconds that the other direction gets to notice a reset before its peer is shut down."""

Finished = Callable[["Relay"], None]
"""Is told that a relay has ended."""
WhenReadable = Callable[[socket.socket, Callable[[], object]], None]
"""Has a function called, once, when a socket has bytes, has ended or has failed."""


@dataclass(slots=True, eq=False)
class Relay:
    """One relayed connection.

    ``kind`` and ``name`` say of what; ``caller_id`` and ``peer`` who connected at ``port``:
    somebody outside, or a node inside if ``inside_asks``. ``client_listens``: that one is expected
    to say nothing more. ``sent`` are bytes towards outside, ``received`` bytes towards the inside
    node; ``sent_rate`` and ``received_rate`` are in bytes per second, as of the last `sample`.
    Without ``splice`` all bytes are copied.
    """

    port: int
    kind: str
    name: str
    caller_id: str
    peer: str
    outside: socket.socket
    inside: socket.socket
    splice: bool = True
    inside_asks: bool = False
    client_listens: bool = False
    sent: int = 0
    received: int = 0
    failed: bool = False
    sent_rate: float = 0.0
    received_rate: float = 0.0
    _sampled: tuple[float, int, int] = (0.0, 0, 0)
    _done: tuple[threading.Event, threading.Event] = field(
        default_factory=lambda: (threading.Event(), threading.Event())
    )
    _ended: bool = False

    def start(self, finished: Finished, when_readable: WhenReadable) -> None:
        """Relay both directions in the background; ``finished`` is called from any thread.

        The direction of a client that listens gets a thread when it says something.
        """
        for sock in (self.outside, self.inside):
            _prepare(sock)
        client = self.inside if self.inside_asks else self.outside
        request, reply = (0, 1) if self.inside_asks else (1, 0)
        if self._start_direction(reply, finished):
            if self.client_listens:
                # The end of its connection counts as well: a socket that has ended is readable.
                when_readable(client, lambda: self._start_direction(request, finished, second=True))
            else:
                self._start_direction(request, finished, second=True)

    def end(self) -> None:
        """End both directions; ``finished`` is called when that is done."""
        for sock in (self.outside, self.inside):
            with contextlib.suppress(OSError):
                sock.shutdown(socket.SHUT_RDWR)

    def sample(self, now: float) -> None:
        """Compute the rates since the last sample; ``now`` is in seconds."""
        sampled_at, sent, received = self._sampled
        self._sampled = (now, self.sent, self.received)
        if sampled_at and now > sampled_at:
            elapsed = now - sampled_at
            self.sent_rate = round((self.sent - sent) / elapsed, 1)
            self.received_rate = round((self.received - received) / elapsed, 1)

    def _start_direction(self, index: int, finished: Finished, second: bool = False) -> bool:
        """Whether the direction could be started; if not, both sides are reset.

        ``second``: the other one runs already.
        """
        thread = threading.Thread(
            target=self._direction, args=(index, finished), name=f"relay {self.name}", daemon=True
        )
        try:
            thread.start()
        except RuntimeError as error:
            log.error("relay of %s: %s; raise the limit of processes and threads", self.name, error)
            self.failed = True
            if second:
                self._pass_reset_on(index)
            for direction in (index,) if second else (0, 1):
                self._finish(direction, finished)
            return False
        return True

    def _direction(self, index: int, finished: Finished) -> None:
        pair = (self.inside, self.outside) if index == 0 else (self.outside, self.inside)
        count = self._count_sent if index == 0 else self._count_received
        try:
            _Pump(*pair, count, self.splice).run()
            # After `_pass_reset_on` the source only seems to have ended: no FIN before the reset.
            if not self.failed:
                pair[1].shutdown(socket.SHUT_WR)
        except OSError as error:
            log.debug("relay of %s: %s", self.name, error)
            self._pass_reset_on(index)
        self._finish(index, finished)

    def _count_sent(self, size: int) -> None:
        self.sent += size

    def _count_received(self, size: int) -> None:
        self.received += size

    def _pass_reset_on(self, index: int) -> None:
        """Wake the other direction without a FIN on the wire, so that closing sends a reset."""
        self.failed = True
        # SHUT_RD wakes a thread that reads, and sends nothing. One that can't write is woken by
        # SHUT_WR alone, which sends a FIN: so that comes last.
        for how in (socket.SHUT_RD, socket.SHUT_WR):
            for sock in (self.outside, self.inside):
                with contextlib.suppress(OSError):
                    sock.shutdown(how)
            if self._done[1 - index].wait(RESET_GRACE):
                return

    def _finish(self, index: int, finished: Finished) -> None:
        """Note that a direction has ended; the first thread to see both ended closes."""
        self._done[index].set()
        with _END:
            if self._ended or not self._done[1 - index].is_set():
                return
            self._ended = True
        for sock in (self.outside, self.inside):
            if self.failed:
                reset_on_close(sock)
            sock.close()
        finished(self)


_END = threading.Lock()


def _prepare(sock: socket.socket) -> None:
    sock.setblocking(True)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    if hasattr(socket, "TCP_KEEPIDLE"):
        # After 60 s, as roscpp (transport_tcp.cpp, initializeSocket) and rospy (tcpros_base.py,
        # connect) do; Linux would begin after two hours (tcp(7), tcp_keepalive_time).
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 60)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 15)


class _Pump:
    """One direction: from ``source`` to ``target`` until the source ends. Raises OSError."""

    def __init__(
        self,
        source: socket.socket,
        target: socket.socket,
        count: Callable[[int], None],
        may_splice: bool,
    ) -> None:
        self._source = source
        self._target = target
        self._count = count
        self._may_splice = may_splice and hasattr(os, "splice")
        self._shares = False

    def run(self) -> None:
        while self._copy() and self._bulk():
            pass

    def _copy(self) -> bool:
        """Copy until a read is full; False at the end."""
        receive = self._source.recv
        send = self._target.sendall
        count = self._count
        while data := receive(COPY_SIZE):
            send(data)
            count(len(data))
            if len(data) == COPY_SIZE:
                return True
        return False

    def _bulk(self) -> bool:
        """Move many bytes at once until a read is small; False at the end.

        The pipe is held no longer than that: pipes are scarce for an unprivileged user.
        """
        with _CROWD.joined(self) as size:
            if not self._may_splice:
                return self._copy_blocks()
            with _pipe(PIPE_SIZE if size <= LARGE_PIPES else SHARED_PIPE) as pipe:
                return self._splice(*pipe) if pipe else self._copy_blocks()

    def share_memory(self) -> None:
        """Bound what the kernel holds for this direction, for as long as it is open."""
        if self._shares:
            return
        self._shares = True
        with contextlib.suppress(OSError):  # closed in the meantime: another thread asks
            self._source.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, SHARED_RECEIVE)
            self._target.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SHARED_SEND)

    def _splice(self, read_end: int, write_end: int) -> bool:
        source = self._source.fileno()
        target = self._target.fileno()
        splice = os.splice
        count = self._count
        while True:
            size = remaining = splice(source, write_end, PIPE_SIZE)
            while remaining:
                remaining -= splice(read_end, target, remaining)
            count(size)
            if size < COPY_SIZE:
                return size > 0

    def _copy_blocks(self) -> bool:
        receive = self._source.recv
        send = self._target.sendall
        count = self._count
        while data := receive(BLOCK_SIZE):
            send(data)
            count(len(data))
            if len(data) < COPY_SIZE:
                return True
        return False


@contextlib.contextmanager
def _pipe(size: int) -> Iterator[tuple[int, int] | None]:
    """A pipe that is worth splicing through, or None.

    An unprivileged user has pages for some pipes (pipe-user-pages-soft); beyond that they hold
    two pages each, and copying is faster.
    """
    try:
        ends = os.pipe()
    except OSError as error:  # no file descriptor left
        log.debug("no pipe: %s", error)
        yield None
        return
    try:
        with contextlib.suppress(OSError):
            fcntl.fcntl(ends[1], fcntl.F_SETPIPE_SZ, size)
        yield ends if fcntl.fcntl(ends[1], fcntl.F_GETPIPE_SZ) >= LEAST_PIPE else None
    finally:
        for end in ends:
            os.close(end)


class _BusyDirections:
    """The directions that move many bytes at the moment."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pumps: set[_Pump] = set()

    @contextlib.contextmanager
    def joined(self, pump: _Pump) -> Iterator[int]:
        """How many there are with this one; in a crowd all of them share memory."""
        with self._lock:
            self._pumps.add(pump)
            size = len(self._pumps)
            # All have to share when the crowd comes about, then each new one.
            sharers = list(self._pumps) if size == CROWD + 1 else [pump] * (size > CROWD)
        try:
            for sharer in sharers:
                sharer.share_memory()
            yield size
        finally:
            with self._lock:
                self._pumps.discard(pump)


_CROWD = _BusyDirections()
