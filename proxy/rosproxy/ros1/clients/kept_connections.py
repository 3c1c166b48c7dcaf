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
from rosproxy.ros1.clients.master_client import MasterError, Unreachable
from rosproxy.ros1.clients.node_client import NodeClient
from rosproxy.ros1.registry.node_health import ProbeResult

LONGEST_ANSWER = 4096
"""Bytes of an answer with its header: rospy's have 400."""

_OK = b"HTTP/1.1 200 "
_LENGTH = re.compile(rb"\r\nContent-Length:\s*(\d{1,4})\s*(?:\r\n|\Z)", re.IGNORECASE)

_K = TypeVar("_K")


@dataclass(slots=True, eq=False)
class _Connection:
    """A connection to a node; ``body`` is that of its latest answer.

    ``question`` is what has not been sent yet of the last request, which was made at ``asked_at``,
    and ``received`` what has come of its answer.
    """

    sock: socket.socket
    slave: HostPort
    pid: int
    body: bytes = b""
    asked_at: float = 0.0
    question: bytes = b""
    received: bytes = b""

    def send(self) -> None:
        """Send what the kernel takes. Raises OSError, BlockingIOError while it is connecting."""
        while self.question:
            self.question = self.question[self.sock.send(self.question) :]


class KeptConnections(Generic[_K]):
    """At most one connection for each node to be asked, ``most`` in all, by keys of the caller's.

    An answer has to come ``within`` so many seconds. Times are seconds of a monotonic clock.
    """

    def __init__(self, nodes: NodeClient, within: float) -> None:
        self._nodes = nodes
        self._within = within
        self.most = 0  # until it is known how many files may be open (`Ros1.reserve_range`)
        self._connections: dict[_K, _Connection] = {}
        self._waiting: dict[_K, _Connection] = {}
        self._key_by_fd: dict[int, _K] = {}
        self._epoll = select.epoll()

    def ask(self, key: _K, slave: HostPort, pid: int, now: float) -> bool:
        """Ask a node for its pid, unless an answer is waited for; False if there is no way to.

        The connection is made with the first question, and given up if the node is to be another
        process, or elsewhere.
        """
        conn = self._connections.get(key)
        if conn is not None and (conn.slave, conn.pid) != (slave, pid):
            self.close(key)
            conn = None
        if key in self._waiting:
            return True
        try:
            conn = conn or self._connect(key, slave, pid)
        except OSError:
            return False
        if conn is None:
            return False
        conn.asked_at = now
        conn.question = self._nodes.pid_question(slave)
        conn.received = b""
        self._waiting[key] = conn
        with contextlib.suppress(OSError):  # `collect` finds out
            conn.send()
        return True

    def collect(self, now: float) -> dict[_K, ProbeResult | None]:
        """What has become of the connections since the last time, by their keys.

        Their nodes have answered, have been SILENT for too long, or (None) refused or ended the
        connection, or sent something else.
        """
        results = dict(self._answers(now))
        # In this order: an end counts even if the node has answered before it.
        results.update({self._key_by_fd[fd]: None for fd, _ in self._epoll.poll(0)})
        for key, result in results.items():
            if result is ProbeResult.ANSWERED:
                del self._waiting[key]
            elif result is ProbeResult.SILENT:
                self._leave(key)
            else:
                self.close(key)
        return results

    def keep(self, keys: set[_K]) -> None:
        """Close the connections of all other keys."""
        for key in [key for key in self._connections if key not in keys]:
            self.close(key)

    def close(self, key: _K) -> None:
        """Close the connection of a node that is not to be asked any more."""
        conn = self._connections.pop(key, None)
        self._waiting.pop(key, None)
        if conn is not None:
            del self._key_by_fd[conn.sock.fileno()]
            conn.sock.close()

    def _leave(self, key: _K) -> None:
        """Give up a connection on which an answer is due."""
        conn = self._connections.pop(key)
        del self._waiting[key], self._key_by_fd[conn.sock.fileno()]
        # The socket stays open until its answer has come, so it does not leave epoll by itself, as
        # those do that are closed (epoll(7)).
        self._epoll.unregister(conn.sock)
        self._nodes.close_after_answer(conn.sock)

    def close_all(self) -> None:
        """Close all connections, for good."""
        self.most = 0
        self.keep(set())
        self._epoll.close()

    def _connect(self, key: _K, slave: HostPort, pid: int) -> _Connection | None:
        """Begin to connect; None if there are as many as there may be. Raises OSError."""
        if len(self._connections) >= self.most:
            return None
        sock = self._nodes.connect(slave)
        # A refused connection is told as well: EPOLLHUP and EPOLLERR always are (epoll_ctl(2)).
        self._epoll.register(sock, select.EPOLLRDHUP)
        self._key_by_fd[sock.fileno()] = key
        self._connections[key] = conn = _Connection(sock, slave, pid)
        return conn

    def _answers(self, now: float) -> Iterator[tuple[_K, ProbeResult | None]]:
        for key, conn in self._waiting.items():
            try:
                conn.send()
                yield key, self._read(conn)
            except BlockingIOError:
                if now - conn.asked_at > self._within:
                    yield key, ProbeResult.SILENT
            except OSError:
                yield key, None

    def _read(self, conn: _Connection) -> ProbeResult | None:
        """ANSWERED by the answer that is expected, None by anything else.

        Raises BlockingIOError while it has not come, or not all of it, and OSError.
        """
        chunk = conn.sock.recv(LONGEST_ANSWER)
        conn.received += chunk
        head, end, body = conn.received.partition(b"\r\n\r\n")
        if chunk and not end and len(head) < LONGEST_ANSWER:
            raise BlockingIOError
        length = _length(head)
        if not chunk or not head.startswith(_OK) or len(body) > length:
            return None
        if len(body) < length:
            raise BlockingIOError
        if body != conn.body and not self._is_from(conn.pid, body):
            return None
        conn.body = body
        conn.received = b""
        return ProbeResult.ANSWERED

    def _is_from(self, pid: int, body: bytes) -> bool:
        try:
            return self._nodes.read_pid(body) == pid
        except (Unreachable, MasterError):
            return False


def _length(head: bytes) -> int:
    """How long a body is, by its header; -1 if that does not tell."""
    match = _LENGTH.search(head)
    return int(match[1]) if match and int(match[1]) <= LONGEST_ANSWER else -1
