"""Bounds on the connections from a source, the connections to a port, and silent connections.

A connection counts from `Gate.enter` to `Gate.leave`: first while the acceptor holds the
connection, then while the HTTP server or the relay does. A connection *waits* until the client has
sent bytes. If a source has too many connections, the gate ends the connection of that source that
has waited longest. So the source keeps the connections in use, and other sources get file
descriptors.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count

from rosproxy.shared.addresses import subnet
from rosproxy.shared.connections.source_shares import SourceShares
from rosproxy.shared.fixes import how_to_in_a_sentence

MOST_WAITING = 512
"""Most waiting connections of a source. In ROS 1 the client sends first, at once."""
LEAST_PER_SOURCE = 64
"""Connections that each source may have, even if there are few file descriptors."""
FILES_PER_CONNECTION = 2
"""All sources may have a connection for every 2 file descriptors that the process may open, because
a relay takes two. For large transfers it takes up to four more, and forwards more slowly without.
A source gets no more than it leaves to others: half of all connections if it is the only one."""

NoteRefusal = Callable[[str, str, str], None]
"""Takes the reason of a refusal in one word, the source, and a text."""


class Gate:
    """Counts connections, and refuses or ends connections above the bounds.

    ``per_source`` and ``per_port`` are the bounds.
    """

    def __init__(self, per_source: int, per_port: int, note_refusal: NoteRefusal) -> None:
        self.per_source = per_source
        self._file_limit = 0
        self._per_port = per_port
        self._note_refusal = note_refusal
        self._by_source = SourceShares()
        self._most: int | None = None
        """The highest number of connections of all sources, as far as files bound them."""
        self._total = 0
        self._by_port: Counter[int] = Counter()
        self._waiting: dict[str, dict[int, Callable[[], None]]] = {}
        self._numbers = count()

    def bound(self, files: int) -> None:
        """Lower the bounds if the process may open only this number of ``files``."""
        self._most = max(files // FILES_PER_CONNECTION, 2 * LEAST_PER_SOURCE)
        self._file_limit = files

    def admits(self, source: str, port: int) -> bool:
        """Whether the acceptor may accept a connection from a source at a port.

        If the source has too many connections, the gate reports that, and ends the source's oldest
        waiting connection to make room. False if there is none to end.
        """
        if self._by_port[port] >= self._per_port:
            text = f"port {port} already has {self._per_port} connections. "
            text += how_to_in_a_sentence("connections to a port")
            self._note_refusal("connections_per_lease", source, text)
            return False
        reason = self._reason_full(source)
        if reason is None:
            return True
        self._note_refusal("connections_per_source", source, reason)
        return self._end_oldest(source)

    def enter(self, source: str, port: int) -> None:
        """Count a connection."""
        self._by_source.add(source)
        self._by_port[port] += 1
        self._total += 1

    def leave(self, source: str, port: int) -> None:
        """Stop counting a connection."""
        self._by_source.add(source, -1)
        self._total -= 1
        self._by_port[port] -= 1
        if not self._by_port[port]:
            del self._by_port[port]

    def note_waiting(self, source: str, end: Callable[[], None]) -> Callable[[], None]:
        """Note a waiting connection; ``end`` ends the connection.

        Return the function to call when the client has sent bytes, or the connection is gone.
        """
        number = next(self._numbers)
        connections = self._waiting.setdefault(source, {})
        if len(connections) >= MOST_WAITING:
            text = f"the source already has {MOST_WAITING} connections on which it has sent nothing"
            self._note_refusal("silent_connections", source, text)
            self._end_oldest(source)
        self._waiting.setdefault(source, {})[number] = end

        def spoke() -> None:
            waiting = self._waiting.get(source, {})
            waiting.pop(number, None)
            if not waiting:
                self._waiting.pop(source, None)

        return spoke

    @contextmanager
    def waiting(self, source: str, end: Callable[[], None]) -> Iterator[None]:
        """Note a waiting connection until the context ends; ``end`` ends the connection."""
        spoke = self.note_waiting(source, end)
        try:
            yield
        finally:
            spoke()

    def _reason_full(self, source: str) -> str | None:
        """Why a source may have no more connections; None if it may."""
        count = self._by_source.of(source)
        in_network = self._by_source.of_network(source)
        if not self._by_source.has_room(source, self.per_source):
            holder = f"network {subnet(source)}" if count < self.per_source else "the source"
            text = f"{holder} already has {max(count, in_network)} connections"
            return f"{text}. {how_to_in_a_sentence('connections of a source')}"
        if self._most is None or in_network < self._most - self._total:
            return None
        return (
            f"the source has {in_network} of the {self._most} connections that the "
            f"{self._file_limit} open files of the proxy allow, and leaves fewer to others. "
            + how_to_in_a_sentence("open files")
        )

    def _end_oldest(self, source: str) -> bool:
        """End the oldest waiting connection of a source; False if no connection waits."""
        waiting = self._waiting.get(source)
        if not waiting:
            return False
        waiting.pop(next(iter(waiting)))()
        return True
