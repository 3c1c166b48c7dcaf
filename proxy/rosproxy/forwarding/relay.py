"""Relays: bytes between two sockets, with a blocking thread for each direction.

On Linux large transfers move by splice(2) through a pipe, and never enter Python. For messages
below some 8 KiB a copy costs the same, and needs no pipe. Back-pressure comes from the kernel: a
thread that can't write doesn't read. Each call that blocks releases the GIL.
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
"""Bytes of a read while copying; a full read switches the direction to splice.

From this size on splice costs less, the opening of a pipe included.
"""
PIPE_SIZE = 1024 * 1024
"""Bytes of a splice pipe; the kernel may give an unprivileged process less."""
LARGE_PIPES = 16
"""Pipes of PIPE_SIZE at the same time. With more streams the CPU is busy, and turns are shorter."""
SHARED_PIPE = 256 * 1024
"""Bytes of each further pipe: an unprivileged user has 64 MiB for all pipes together."""
CROWD = 128
"""Directions with large transfers at the same time before all of them share memory."""
SHARED_RECEIVE = 128 * 1024
"""Bytes of the receive buffer of a socket in a crowd; Linux doubles the value (socket(7)).

By default each buffer grows to several MiB. A thousand such buffers reach the limit for all TCP
connections of the machine (tcp_mem). From there on Linux drops packets and sends single pages.
"""
SHARED_SEND = 208 * 1024
"""Bytes of the send buffer in a crowd: the default of wmem_max, which every process may set."""
LEAST_PIPE = 64 * 1024
"""Bytes of the smallest pipe that a direction uses for splice."""
BLOCK_SIZE = 128 * 1024
"""Bytes of a read without a pipe. Each read makes a new buffer: Python would zero a bytearray."""
RESET_GRACE = 0.1
"""Seconds in which the other direction may end after SHUT_RD, before SHUT_WR follows."""

Finished = Callable[["Relay"], None]
"""Takes a relay that has ended."""
WhenReadable = Callable[[socket.socket, Callable[[], object]], None]
"""Calls a function once when a socket has bytes, has ended or has failed."""


@dataclass(slots=True, eq=False)
class Relay:
    """A relayed connection.

    ``kind`` (topic or service) and ``name`` say what the connection carries. ``caller_id`` and
    ``peer`` are name and address of the client that has connected to ``port``: outside, or inside
    if ``inside_asks``. ``client_listens``: the client probably sends nothing more.
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

        If ``client_listens``, the direction from the client gets a thread once the client sends.
        """
        for sock in (self.outside, self.inside):
            _prepare(sock)
        client = self.inside if self.inside_asks else self.outside
        request, reply = (0, 1) if self.inside_asks else (1, 0)
        if self._start_direction(reply, finished):
            if self.client_listens:
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

    def _start_direction(self, index: int, finished: Finished, second: bool = False) -> bool:
        """Start the thread of a direction; on failure, reset both sides and return False.

        ``second``: the other direction already runs.
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
            # After `_pass_reset_on` the source seems to have ended: send no FIN before the reset.
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
        """Wake the other direction without a FIN on the wire, so that the close sends a reset."""
        self.failed = True
        # SHUT_RD wakes a thread that reads, and sends nothing. Only SHUT_WR wakes a thread that
        # can't write, but SHUT_WR sends a FIN, so SHUT_WR comes last.
        for how in (socket.SHUT_RD, socket.SHUT_WR):
            for sock in (self.outside, self.inside):
                with contextlib.suppress(OSError):
                    sock.shutdown(how)
            if self._done[1 - index].wait(RESET_GRACE):
                return

    def _finish(self, index: int, finished: Finished) -> None:
        """Note the end of a direction; the first thread that sees both ends closes the sockets."""
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
        """Move large amounts until a read is small; False at the end.

        Then the pipe is closed: an unprivileged user may have few pages of pipes.
        """
        with _CROWD.joined(self) as size:
            if not self._may_splice:
                return self._copy_blocks()
            with _pipe(PIPE_SIZE if size <= LARGE_PIPES else SHARED_PIPE) as pipe:
                return self._splice(*pipe) if pipe else self._copy_blocks()

    def share_memory(self) -> None:
        """Bound the socket buffers of this direction, until the end of the connection."""
        if self._shares:
            return
        self._shares = True
        with contextlib.suppress(OSError):  # called by another thread: may be closed by now
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
    """A pipe of ``size`` bytes if possible; None if the pipe is too small for splice.

    An unprivileged user has a number of pages for pipes (pipe-user-pages-soft, pipe(7)). Further
    pipes get two pages each, and then copying is faster.
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
    """The directions that make large transfers at the moment."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pumps: set[_Pump] = set()

    @contextlib.contextmanager
    def joined(self, pump: _Pump) -> Iterator[int]:
        """Add a direction for the context; return the number. In a crowd all share memory."""
        with self._lock:
            self._pumps.add(pump)
            size = len(self._pumps)
            # The first direction beyond CROWD makes all share, each later direction only itself.
            sharers = list(self._pumps) if size == CROWD + 1 else [pump] * (size > CROWD)
        try:
            for sharer in sharers:
                sharer.share_memory()
            yield size
        finally:
            with self._lock:
                self._pumps.discard(pump)


_CROWD = _BusyDirections()
