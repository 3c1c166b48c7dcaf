"""Kept connections to nodes, by which the proxy asks again and again whether a node answers.

A call with a new connection takes the proxy half a millisecond. With a thousand nodes and a call
every five seconds, this is a tenth of a processor. Over a kept connection, a question is a single
``send`` and an answer a single ``recv``. An answer wakes no task: the next look collects the
answers (`KeptConnections.collect`). An answer with the same body as the last answer has the same
pid, and the proxy does not parse it.

The kernel tells which connections the nodes have ended (EPOLLRDHUP), also after a crash of the
process. So the next look notices the end of a node.

Kept connections are for healthy nodes. After any unexpected answer the proxy closes the connection,
and `NodeClient.probe` finds out how the node is.
"""

import contextlib
import re
import select
import socket
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

from rosproxy.ros1.clients.master_client import MasterError, Unreachable
from rosproxy.ros1.clients.node_client import NodeClient
from rosproxy.ros1.registry.node_health import ProbeResult
from rosproxy.shared.addresses import HostPort

LONGEST_ANSWER_BYTES = 4096
"""Most bytes of the header, and of the body, of an answer. An answer of rospy has 400 bytes."""

_OK = b"HTTP/1.1 200 "
_LENGTH = re.compile(rb"\r\nContent-Length:\s*(\d{1,4})\s*(?:\r\n|\Z)", re.IGNORECASE)

_K = TypeVar("_K")


@dataclass(slots=True, eq=False)
class _Connection:
    """A connection to a node; ``body`` is the body of the latest answer.

    ``question`` is the unsent rest of the last request, from the time ``asked_at``. ``received`` is
    the part of the answer that has arrived.
    """

    sock: socket.socket
    slave: HostPort
    pid: int
    body: bytes = b""
    asked_at: float = 0.0
    question: bytes = b""
    received: bytes = b""

    def send(self) -> None:
        """Send what the kernel takes. Raises OSError, BlockingIOError during the connect."""
        while self.question:
            self.question = self.question[self.sock.send(self.question) :]


class KeptConnections(Generic[_K]):
    """At most one connection for each key of the caller, and ``most`` connections in all.

    An answer has to arrive ``within`` so many seconds. Times are seconds of a monotonic clock.
    """

    def __init__(self, nodes: NodeClient, within: float) -> None:
        self._nodes = nodes
        self._within = within
        self.most = 0  # until the limit of open files is known (`Ros1.reserve_range`)
        self._connections: dict[_K, _Connection] = {}
        self._waiting: dict[_K, _Connection] = {}
        self._key_by_fd: dict[int, _K] = {}
        self._epoll = select.epoll()

    def ask(self, key: _K, slave: HostPort, pid: int, now: float) -> bool:
        """Ask a node for its pid, unless an answer is still due; False without a connection.

        The first question opens the connection. If the pid or address has changed, a new connection
        replaces the old one.
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
        with contextlib.suppress(OSError):  # `collect` notices the error
            conn.send()
        return True

    def collect(self, now: float) -> dict[_K, ProbeResult | None]:
        """The results since the last call, by key.

        ANSWERED: the node has answered with the expected pid. SILENT: no answer in ``within``
        seconds. None: the node has refused or ended the connection, or has sent anything else.
        """
        results = dict(self._answers(now))
        # In this order: an end counts even if the node has answered before the end.
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
        """Close the connection of a node, if there is one."""
        conn = self._connections.pop(key, None)
        self._waiting.pop(key, None)
        if conn is not None:
            del self._key_by_fd[conn.sock.fileno()]
            conn.sock.close()

    def _leave(self, key: _K) -> None:
        """Leave a connection with an answer still due to `NodeClient.close_after_answer`."""
        conn = self._connections.pop(key)
        del self._waiting[key], self._key_by_fd[conn.sock.fileno()]
        # The socket stays open until the answer arrives. Closed sockets leave epoll by themselves
        # (epoll(7)), but this socket does not.
        self._epoll.unregister(conn.sock)
        self._nodes.close_after_answer(conn.sock, conn.received)

    def close_all(self) -> None:
        """Close all connections for good."""
        self.most = 0
        self.keep(set())
        self._epoll.close()

    def _connect(self, key: _K, slave: HostPort, pid: int) -> _Connection | None:
        """Begin to connect; None if the maximum is reached. Raises OSError."""
        if len(self._connections) >= self.most:
            return None
        sock = self._nodes.connect(slave)
        # epoll always reports EPOLLHUP and EPOLLERR, so also a refused connection (epoll_ctl(2)).
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
        """Read the answer: ANSWERED if it is the expected answer, otherwise None.

        Raises BlockingIOError until the whole answer has arrived, and OSError.
        """
        chunk = conn.sock.recv(LONGEST_ANSWER_BYTES)
        conn.received += chunk
        head, end, body = conn.received.partition(b"\r\n\r\n")
        if chunk and not end and len(head) < LONGEST_ANSWER_BYTES:
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
    """The length of the body by the header; -1 if the header has none, or the body is too long."""
    match = _LENGTH.search(head)
    return int(match[1]) if match and int(match[1]) <= LONGEST_ANSWER_BYTES else -1
