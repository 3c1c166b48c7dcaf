"""Connections to nodes that are kept, to ask over and over whether the node still answers.

A call with a connection of its own takes the proxy half a millisecond: a thousand nodes, each asked
every five seconds, would take a tenth of a processor. Over a connection that is kept a question is
one ``send`` and its answer one ``recv``. Nobody is woken by an answer: the next look collects what
has come (`KeptConnections.collect`). An answer that has the body of the one before tells the same
pid, and is not read.

The kernel tells which connections have been ended by their node (EPOLLRDHUP), as it does for a
process that ends in any way. So its end is known at the next look.

All of this is for nodes that are well. At anything but the answer that is expected the connection
is closed, and `NodeClient.probe` has to tell how the node is.
"""

import contextlib
import re
import select
import socket
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

from rosproxy.net.addresses import HostPort
from rosproxy.ros1.clients.master import MasterError, Unreachable
from rosproxy.ros1.clients.node import NodeClient
from rosproxy.ros1.registry.health import ProbeResult

LONGEST_ANSWER = 4096
"""Bytes of an answer with its header: rospy's have 400."""

_OK = b"HTTP/1.1 200 "
_LENGTH = re.compile(rb"\r\nContent-Length:\s*(\d{1,4})\s*(?:\r\n|\Z)", re.IGNORECASE)

_K = TypeVar("_K")


@dataclass(slots=True, eq=False)
class _Kept:
    """A connection; ``body`` is that of all answers.

    ``question`` is what has not been sent yet of the last one, which was ``asked`` at a time, and
    ``received`` what has come of its answer.
    """

    sock: socket.socket
    where: HostPort
    pid: int
    body: bytes = b""
    asked: float = 0.0
    question: bytes = b""
    received: bytes = b""

    def send(self) -> None:
        """Send what the kernel takes. Raises OSError, BlockingIOError while it is connecting."""
        while self.question:
            self.question = self.question[self.sock.send(self.question) :]


class KeptConnections(Generic[_K]):
    """At most one connection for each of those who are to be asked, ``most`` in all.

    An answer has to come ``within`` so many seconds. Times are seconds of a monotonic clock.
    """

    def __init__(self, nodes: NodeClient, within: float) -> None:
        self._nodes, self._within = nodes, within
        self.most = 0
        self._kept: dict[_K, _Kept] = {}
        self._waiting: dict[_K, _Kept] = {}
        self._by_number: dict[int, _K] = {}
        self._ended = select.epoll()

    def ask(self, who: _K, where: HostPort, pid: int, now: float) -> bool:
        """Ask a node for its pid, unless an answer is waited for; False if there is no way to.

        The connection is made with the first question, and given up if the node is to be another
        process, or elsewhere.
        """
        kept = self._kept.get(who)
        if kept is not None and (kept.where, kept.pid) != (where, pid):
            self.close(who)
            kept = None
        if who in self._waiting:
            return True
        try:
            kept = kept or self._connect(who, where, pid)
        except OSError:
            return False
        if kept is None:
            return False
        kept.asked, kept.question, kept.received = now, self._nodes.pid_question(where), b""
        self._waiting[who] = kept
        with contextlib.suppress(OSError):  # `collect` finds out
            kept.send()
        return True

    def collect(self, now: float) -> dict[_K, ProbeResult | None]:
        """What has become of the connections since the last time, by those who were asked.

        They have answered, have been SILENT for too long, or (None) refused or ended the
        connection, or sent something else.
        """
        found = dict(self._answers(now))
        found.update({self._by_number[number]: None for number, _ in self._ended.poll(0)})
        for who, result in found.items():
            if result is ProbeResult.ANSWERED:
                del self._waiting[who]
            elif result is ProbeResult.SILENT:
                self._leave(who)
            else:
                self.close(who)
        return found

    def keep(self, those: set[_K]) -> None:
        """Close the connections of all others."""
        for who in [one for one in self._kept if one not in those]:
            self.close(who)

    def close(self, who: _K) -> None:
        """Close the connection of somebody who is not to be asked any more."""
        kept = self._kept.pop(who, None)
        self._waiting.pop(who, None)
        if kept is not None:
            del self._by_number[kept.sock.fileno()]
            kept.sock.close()

    def _leave(self, who: _K) -> None:
        """Give up a connection on which an answer is due."""
        kept = self._kept.pop(who)
        del self._waiting[who], self._by_number[kept.sock.fileno()]
        self._ended.unregister(kept.sock)
        self._nodes.leave(kept.sock)

    def close_all(self) -> None:
        """Close all connections, for good."""
        self.most = 0
        self.keep(set())
        self._ended.close()

    def _connect(self, who: _K, where: HostPort, pid: int) -> _Kept | None:
        """Begin to connect; None if there are as many as there may be. Raises OSError."""
        if len(self._kept) >= self.most:
            return None
        sock = self._nodes.connect(where)
        self._ended.register(sock, select.EPOLLRDHUP)
        self._by_number[sock.fileno()] = who
        self._kept[who] = kept = _Kept(sock, where, pid)
        return kept

    def _answers(self, now: float) -> Iterator[tuple[_K, ProbeResult | None]]:
        for who, kept in self._waiting.items():
            try:
                kept.send()
                yield who, self._read(kept)
            except BlockingIOError:
                if now - kept.asked > self._within:
                    yield who, ProbeResult.SILENT
            except OSError:
                yield who, None

    def _read(self, kept: _Kept) -> ProbeResult | None:
        """ANSWERED by the answer that is expected, None by anything else.

        Raises BlockingIOError while it has not come, or not all of it, and OSError.
        """
        part = kept.sock.recv(LONGEST_ANSWER)
        kept.received += part
        head, end, body = kept.received.partition(b"\r\n\r\n")
        if part and not end and len(head) < LONGEST_ANSWER:
            raise BlockingIOError
        length = _length(head)
        if not part or not head.startswith(_OK) or len(body) > length:
            return None
        if len(body) < length:
            raise BlockingIOError
        if body != kept.body and not self._is_from(kept.pid, body):
            return None
        kept.body, kept.received = body, b""
        return ProbeResult.ANSWERED

    def _is_from(self, pid: int, body: bytes) -> bool:
        try:
            return self._nodes.read_pid(body) == pid
        except (Unreachable, MasterError):
            return False


def _length(head: bytes) -> int:
    """How long a body is, by its header; -1 if that does not tell."""
    found = _LENGTH.search(head)
    return int(found[1]) if found and int(found[1]) <= LONGEST_ANSWER else -1
