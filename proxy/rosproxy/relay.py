"""Moving bytes between two sockets: one blocking thread per direction.

On Linux bulk data moves by splice(2) through a pipe and never enters Python; small messages are
copied, which is one system call less. Back-pressure is the kernel's own: a thread that can't
write doesn't read. The GIL is released in every call that blocks.
"""

import contextlib
import fcntl
import logging
import os
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

log = logging.getLogger(__name__)

COPY_SIZE = 16 * 1024
"""Bytes read at once while copying; a full read switches the direction to splice."""
PIPE_SIZE = 1024 * 1024
"""Bytes that a splice pipe should hold; the kernel may give an unprivileged process less."""
LEAST_PIPE = 64 * 1024
"""A pipe that holds fewer bytes is not spliced through."""
BLOCK_SIZE = 256 * 1024
"""Bytes copied at once where there is no pipe."""
RESET_GRACE = 0.1
"""Seconds that the other direction gets to notice a reset before its peer is shut down."""

_LINGER_RESET = struct.pack("ii", 1, 0)


@dataclass(slots=True, eq=False)
class Relay:
    """One relayed connection.

    ``kind`` is topic or service and ``name`` which; ``caller_id`` and ``peer`` tell who connected
    from outside. ``sent`` are bytes towards outside, ``received`` bytes towards the inside node;
    ``rates`` are both in bytes per second, as of the last `sample`.
    """

    port: int
    kind: str
    name: str
    caller_id: str
    peer: str
    outside: socket.socket
    inside: socket.socket
    sent: int = 0
    received: int = 0
    failed: bool = False
    rates: tuple[float, float] = (0.0, 0.0)
    _sampled: tuple[float, int, int] = (0.0, 0, 0)
    _done: tuple[threading.Event, threading.Event] = field(
        default_factory=lambda: (threading.Event(), threading.Event())
    )
    _ended: bool = False

    def start(self, finished: Callable[["Relay"], None]) -> None:
        """Relay both directions in the background; ``finished`` is called from a thread."""
        for sock in (self.outside, self.inside):
            _prepare(sock)
        threads = [
            threading.Thread(
                target=self._direction, args=(index, finished), name=f"relay {self.name}"
            )
            for index in (0, 1)
        ]
        for index, thread in enumerate(threads):
            thread.daemon = True
            try:
                thread.start()
            except RuntimeError as error:
                self._give_up(error, index, finished)
                return

    def end(self) -> None:
        """End both directions; ``finished`` is called when that is done."""
        for sock in (self.outside, self.inside):
            with contextlib.suppress(OSError):
                sock.shutdown(socket.SHUT_RDWR)

    def sample(self, now: float) -> None:
        """Compute the rates since the last sample; ``now`` is in seconds."""
        before, sent, received = self._sampled
        self._sampled = (now, self.sent, self.received)
        if before and now > before:
            passed = now - before
            self.rates = (self.sent - sent) / passed, (self.received - received) / passed

    def _direction(self, index: int, finished: Callable[["Relay"], None]) -> None:
        pair = (self.inside, self.outside) if index == 0 else (self.outside, self.inside)
        try:
            _Pump(*pair, self._count_sent if index == 0 else self._count_received).run()
            self._pass_end_on(pair[1])
        except OSError as error:
            log.debug("relay of %s: %s", self.name, error)
            self._pass_reset_on(index)
        self._finish(index, finished)

    def _give_up(
        self, error: RuntimeError, index: int, finished: Callable[["Relay"], None]
    ) -> None:
        """Reset both sides: direction ``index`` can't be started, those before it run."""
        log.error("relay of %s: %s; raise the limit of processes and threads", self.name, error)
        self.failed = True
        if index:
            self._pass_reset_on(index)
        for left in range(index, 2):
            self._finish(left, finished)

    def _count_sent(self, size: int) -> None:
        self.sent += size

    def _count_received(self, size: int) -> None:
        self.received += size

    def _pass_end_on(self, target: socket.socket) -> None:
        if not self.failed:
            target.shutdown(socket.SHUT_WR)

    def _pass_reset_on(self, index: int) -> None:
        """Wake the other direction without a FIN on the wire, so that closing sends a reset."""
        self.failed = True
        for how in (socket.SHUT_RD, socket.SHUT_WR):
            for sock in (self.outside, self.inside):
                with contextlib.suppress(OSError):
                    sock.shutdown(how)
            if self._done[1 - index].wait(RESET_GRACE):
                return

    def _finish(self, index: int, finished: Callable[["Relay"], None]) -> None:
        self._done[index].set()
        if not self._done[1 - index].is_set() or not self._claim_end():
            return
        for sock in (self.outside, self.inside):
            if self.failed:
                reset_on_close(sock)
            sock.close()
        finished(self)

    def _claim_end(self) -> bool:
        """Whether this thread is the one to close: the first to ask."""
        with _END:
            first, self._ended = not self._ended, True
        return first


_END = threading.Lock()


def reset_on_close(sock: socket.socket) -> None:
    """Make closing a socket send a reset instead of an orderly end."""
    with contextlib.suppress(OSError):
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER_RESET)


def _prepare(sock: socket.socket) -> None:
    sock.setblocking(True)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    if hasattr(socket, "TCP_KEEPIDLE"):
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 60)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 15)


class _Pump:
    """One direction: from ``source`` to ``target`` until the source ends. Raises OSError."""

    def __init__(
        self, source: socket.socket, target: socket.socket, count: Callable[[int], None]
    ) -> None:
        self._source, self._target, self._count = source, target, count

    def run(self) -> None:
        while self._copy() and self._bulk():
            pass

    def _copy(self) -> bool:
        """Copy until a read is full; False at the end."""
        while data := self._source.recv(COPY_SIZE):
            self._target.sendall(data)
            self._count(len(data))
            if len(data) == COPY_SIZE:
                return True
        return False

    def _bulk(self) -> bool:
        """Move many bytes at once until a read is small; False at the end.

        The pipe is held no longer than that: pipes are scarce for an unprivileged user.
        """
        with _pipe() as pipe:
            return self._splice(*pipe) if pipe else self._copy_blocks()

    def _splice(self, read_end: int, write_end: int) -> bool:
        source, target = self._source.fileno(), self._target.fileno()
        while True:
            size = left = os.splice(source, write_end, PIPE_SIZE)
            while left:
                left -= os.splice(read_end, target, left)
            self._count(size)
            if size < COPY_SIZE:
                return size > 0

    def _copy_blocks(self) -> bool:
        block = memoryview(bytearray(BLOCK_SIZE))
        while True:
            size = self._source.recv_into(block)
            self._target.sendall(block[:size])
            self._count(size)
            if size < COPY_SIZE:
                return size > 0


@contextlib.contextmanager
def _pipe() -> Iterator[tuple[int, int] | None]:
    """A pipe that is worth splicing through, or None.

    An unprivileged user has pages for some pipes (pipe-user-pages-soft); beyond that they hold
    two pages each, and copying is faster.
    """
    try:
        ends = os.pipe() if hasattr(os, "splice") else None
    except OSError as error:  # no file descriptor left
        log.debug("no pipe: %s", error)
        ends = None
    if ends is None:
        yield None
        return
    try:
        with contextlib.suppress(OSError):
            fcntl.fcntl(ends[1], fcntl.F_SETPIPE_SZ, PIPE_SIZE)
        yield ends if fcntl.fcntl(ends[1], fcntl.F_GETPIPE_SZ) >= LEAST_PIPE else None
    finally:
        for end in ends:
            os.close(end)
