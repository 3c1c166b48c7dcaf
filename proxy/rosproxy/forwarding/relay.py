"""Relays: bytes between two sockets, with a blocking thread for each direction.

A direction copies small messages. On Linux a direction with large transfers uses splice(2) and a
pipe, so the bytes never enter Python. Back-pressure comes from the kernel: a thread that can't
write doesn't read. Each call that blocks releases the GIL.
"""

import contextlib
import fcntl
import logging
import os
import socket
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import IntEnum

from rosproxy.shared.connections.sockets import reset_on_close

log = logging.getLogger(__name__)

COPY_BYTES = 16 * 1024
"""Bytes of a read while copying; a full read switches the direction to splice.

For smaller amounts, splice and the opening of a pipe cost no less than a copy.
"""
PIPE_BYTES = 1024 * 1024
"""Bytes of a splice pipe; the kernel may give an unprivileged process less."""
MOST_LARGE_PIPES = 16
"""The highest number of pipes of PIPE_BYTES. With more streams the CPU is busy, and each call of
splice moves less, so large pipes bring nothing."""
FURTHER_PIPE_BYTES = 256 * 1024
"""Bytes of each further pipe: an unprivileged user has 64 MiB for all pipes together."""
MOST_UNBOUNDED_DIRECTIONS = 128
"""Up to this number of directions with large transfers at the same time, the kernel chooses the
sizes of the socket buffers. With more, the proxy bounds the buffers of each such direction."""
RECEIVE_BUFFER_BYTES = 128 * 1024
"""The bound of a receive buffer; Linux doubles the value (socket(7)).

By default each buffer grows to several MiB. A thousand such buffers reach the limit for all TCP
connections of the machine (tcp_mem). Above this limit Linux drops packets, and sends at most a page
at a time.
"""
SEND_BUFFER_BYTES = 208 * 1024
"""The bound of a send buffer. Any process may set a buffer of this size: it is the default of
wmem_max."""
LEAST_PIPE_BYTES = 64 * 1024
"""Bytes of the smallest pipe that a direction uses for splice."""
BLOCK_BYTES = 128 * 1024
"""Bytes of a read without a pipe. ``recv`` makes a new buffer for each read. A bytearray for each
read costs more, because Python fills a new bytearray with zeros."""
RESET_GRACE_S = 0.1
"""Seconds in which the other direction may end after SHUT_RD, before SHUT_WR follows."""

Finished = Callable[["Relay"], None]
"""Takes a relay that has ended."""
WhenReadable = Callable[[socket.socket, Callable[[], object]], None]
"""Calls a function once when a socket has bytes, has ended or has failed."""


class RelayDirection(IntEnum):
    """A direction of a relay."""

    OUTWARDS = 0
    INWARDS = 1

    @property
    def opposite(self) -> "RelayDirection":
        """The other direction."""
        return RelayDirection(1 - self)


@dataclass(slots=True, eq=False)
class Relay:
    """A relayed connection.

    ``kind`` (topic or service) and ``name`` say what the connection carries. ``caller_id`` and
    ``peer`` are name and address of the client that has connected to ``port``. The client is
    outside, or inside if ``inside_asks``. ``client_is_silent``: the client probably sends nothing
    more. ``failed``: a direction has ended with an error, so the proxy resets both connections.
    ``sent`` are bytes towards outside, ``received`` bytes towards inside. ``sent_rate`` and
    ``received_rate`` are in bytes per second, as of the last `sample`. Without ``splice`` all bytes
    are copied.
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
    client_is_silent: bool = False
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
        """Relay both directions in threads; one of these threads calls ``finished``.

        If ``client_is_silent``, the direction from the client gets a thread once the client sends.
        If a direction can't get a thread, the calling thread or the event loop's thread may call
        ``finished``.
        """
        for sock in (self.outside, self.inside):
            _prepare(sock)
        client = self.inside if self.inside_asks else self.outside
        request = RelayDirection.OUTWARDS if self.inside_asks else RelayDirection.INWARDS
        if self._start_direction(request.opposite, finished):
            if self.client_is_silent:
                # The end of the connection starts the thread, too: the socket is then readable.
                when_readable(client, lambda: self._start_direction(request, finished, second=True))
            else:
                self._start_direction(request, finished, second=True)

    def end(self) -> None:
        """End both directions; ``finished`` is called once both have ended."""
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

    def _start_direction(
        self, direction: RelayDirection, finished: Finished, second: bool = False
    ) -> bool:
        """Start the thread of a direction; on failure, reset both sides and return False.

        ``second``: the other direction already runs.
        """
        thread = threading.Thread(
            target=self._run, args=(direction, finished), name=f"relay {self.name}", daemon=True
        )
        try:
            thread.start()
        except RuntimeError as error:
            log.error("relay of %s: %s; raise the limit of processes and threads", self.name, error)
            self.failed = True
            if second:
                self._pass_reset_on(direction)
            for ended in (direction,) if second else RelayDirection:
                self._finish(ended, finished)
            return False
        return True

    def _run(self, direction: RelayDirection, finished: Finished) -> None:
        if direction is RelayDirection.OUTWARDS:
            pump = _Pump(self.inside, self.outside, self._count_sent, self.splice)
        else:
            pump = _Pump(self.outside, self.inside, self._count_received, self.splice)
        try:
            pump.run()
            # The read may have ended because the other direction called `_pass_reset_on`, which
            # calls SHUT_RD. Then a reset follows, so send no FIN.
            if not self.failed:
                pump.target.shutdown(socket.SHUT_WR)
        except OSError as error:
            log.debug("relay of %s: %s", self.name, error)
            self._pass_reset_on(direction)
        self._finish(direction, finished)

    def _count_sent(self, size: int) -> None:
        self.sent += size

    def _count_received(self, size: int) -> None:
        self.received += size

    def _pass_reset_on(self, direction: RelayDirection) -> None:
        """Wake the other direction, if possible without a FIN, so that the close sends a reset.

        ``direction``: the direction that has failed.
        """
        self.failed = True
        # SHUT_RD wakes a thread that reads, and sends nothing. Only SHUT_WR wakes a thread that
        # can't write, but SHUT_WR sends a FIN, so SHUT_WR comes last.
        for how in (socket.SHUT_RD, socket.SHUT_WR):
            for sock in (self.outside, self.inside):
                with contextlib.suppress(OSError):
                    sock.shutdown(how)
            if self._done[direction.opposite].wait(RESET_GRACE_S):
                return

    def _finish(self, direction: RelayDirection, finished: Finished) -> None:
        """Note the end of a direction.

        The first thread that finds both directions ended closes the sockets.
        """
        self._done[direction].set()
        with _end_lock:
            if self._ended or not self._done[direction.opposite].is_set():
                return
            self._ended = True
        for sock in (self.outside, self.inside):
            if self.failed:
                reset_on_close(sock)
            sock.close()
        finished(self)


_end_lock = threading.Lock()
"""Guards ``Relay._ended`` of all relays."""


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
    """A direction of a relay: from ``source`` to ``target`` until the source ends.

    `run` raises OSError. ``count`` takes the number of bytes of each step.
    """

    def __init__(
        self,
        source: socket.socket,
        target: socket.socket,
        count: Callable[[int], None],
        may_splice: bool,
    ) -> None:
        self._source = source
        self.target = target
        self._count = count
        self._may_splice = may_splice and hasattr(os, "splice")
        self._is_bounded = False

    def run(self) -> None:
        while self._copy() and self._bulk():
            pass

    def _copy(self) -> bool:
        """Copy; return True after a full read, False if the source has ended."""
        receive = self._source.recv
        send = self.target.sendall
        count = self._count
        while data := receive(COPY_BYTES):
            send(data)
            count(len(data))
            if len(data) == COPY_BYTES:
                return True
        return False

    def _bulk(self) -> bool:
        """Move large amounts; return True after a small read, False if the source has ended.

        The pipe is closed on return: an unprivileged user may have few pages of pipes.
        """
        with _busy_directions.joined(self) as count:
            if not self._may_splice:
                return self._copy_blocks()
            is_large = count <= MOST_LARGE_PIPES
            with _pipe(PIPE_BYTES if is_large else FURTHER_PIPE_BYTES) as pipe:
                return self._splice(*pipe) if pipe else self._copy_blocks()

    def bound_buffers(self) -> None:
        """Bound the socket buffers of this direction, until the end of the connection."""
        if self._is_bounded:
            return
        self._is_bounded = True
        with contextlib.suppress(OSError):  # called by another thread: may be closed by now
            self._source.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
            self.target.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)

    def _splice(self, read_end: int, write_end: int) -> bool:
        source = self._source.fileno()
        target = self.target.fileno()
        splice = os.splice
        count = self._count
        while True:
            size = remaining = splice(source, write_end, PIPE_BYTES)
            while remaining:
                remaining -= splice(read_end, target, remaining)
            count(size)
            if size < COPY_BYTES:
                return size > 0

    def _copy_blocks(self) -> bool:
        receive = self._source.recv
        send = self.target.sendall
        count = self._count
        while data := receive(BLOCK_BYTES):
            send(data)
            count(len(data))
            if len(data) < COPY_BYTES:
                return True
        return False


@contextlib.contextmanager
def _pipe(size: int) -> Iterator[tuple[int, int] | None]:
    """A pipe of ``size`` bytes if possible; None if the pipe is too small for splice.

    An unprivileged user has a limited number of pages for pipes (pipe-user-pages-soft, pipe(7)).
    Beyond this limit a new pipe gets two pages, and then copying is faster.
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
        yield ends if fcntl.fcntl(ends[1], fcntl.F_GETPIPE_SZ) >= LEAST_PIPE_BYTES else None
    finally:
        for end in ends:
            os.close(end)


class _BusyDirections:
    """The directions that make large transfers at the moment."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pumps: set[_Pump] = set()

    @contextlib.contextmanager
    def joined(self, pump: _Pump) -> Iterator[int]:
        """Add a direction for the context; yield the number of directions.

        Above MOST_UNBOUNDED_DIRECTIONS, bound the socket buffers of all directions.
        """
        with self._lock:
            self._pumps.add(pump)
            count = len(self._pumps)
            excess = count - MOST_UNBOUNDED_DIRECTIONS
            # The first direction beyond the limit bounds all, each later direction only itself.
            unbounded = list(self._pumps) if excess == 1 else [pump] if excess > 0 else []
        try:
            for direction in unbounded:
                direction.bound_buffers()
            yield count
        finally:
            with self._lock:
                self._pumps.discard(pump)


_busy_directions = _BusyDirections()
