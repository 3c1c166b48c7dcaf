"""How many connections there may be: from one source, to one port, and silent ones.

A connection is counted from `Gate.enter` to `Gate.leave` by whoever holds it: who accepted it, then
the HTTP server or the relay that it was handed to. One that has not said yet what it wants *waits*;
of a source that has many such the one that has waited longest goes first. So a source that is full
keeps those that it uses, and file descriptors are left for others.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count

from rosproxy.fixes import how_to_in_a_sentence

MOST_WAITING = 512
"""Connections of a source that have not said anything yet. In ROS clients speak first, at once."""
LEAST_PER_SOURCE = 64
"""Connections that a source may have, however few file descriptors there are."""
SHARE = 4
"""Of the file descriptors that the process may open a source gets one in so many connections: a
connection that is relayed takes two, and up to four more while bulk flows."""

NoteRefusal = Callable[[str, str, str], None]
"""Gets the reason of each refusal in one word, the source, and a text."""


class Gate:
    """Counts connections and says which are too many."""

    def __init__(self, per_source: int, per_port: int, note_refusal: NoteRefusal) -> None:
        self.per_source = per_source
        self._few_files = 0
        self._per_port = per_port
        self._note_refusal = note_refusal
        self._by_source: Counter[str] = Counter()
        self._by_port: Counter[int] = Counter()
        self._waiting: dict[str, dict[int, Callable[[], None]]] = {}
        self._numbers = count()

    def bound(self, files: int) -> None:
        """Never let one source have so many that so many open files run out."""
        most = max(files // SHARE, LEAST_PER_SOURCE)
        if most < self.per_source:
            self.per_source = most
            self._few_files = files

    def admits(self, source: str, port: int) -> bool:
        """Whether another connection may come in; makes room if one of the source waits."""
        if self._by_port[port] >= self._per_port:
            text = f"port {port} already has {self._per_port} connections. "
            text += how_to_in_a_sentence("connections to a port")
            self._note_refusal("connections_per_lease", source, text)
            return False
        if self._by_source[source] < self.per_source:
            return True
        text = f"the source already has {self.per_source} connections"
        if self._few_files:
            text += f", as many as the {self._few_files} open files of the proxy allow. "
            text += how_to_in_a_sentence("open files")
        else:
            text += f". {how_to_in_a_sentence('connections of a source')}"
        self._note_refusal("connections_per_source", source, text)
        return self._end_oldest(source)

    def enter(self, source: str, port: int) -> None:
        """Count a connection."""
        self._by_source[source] += 1
        self._by_port[port] += 1

    def leave(self, source: str, port: int) -> None:
        """Count it no more."""
        self._by_source[source] -= 1
        if not self._by_source[source]:
            del self._by_source[source]
        self._by_port[port] -= 1
        if not self._by_port[port]:
            del self._by_port[port]

    def wait(self, source: str, end: Callable[[], None]) -> Callable[[], None]:
        """Note a connection that has said nothing yet; ``end`` ends it.

        Returns what is to be called when it has spoken, or is gone.
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
        """The same for as long as the context lasts."""
        spoke = self.wait(source, end)
        try:
            yield
        finally:
            spoke()

    def _end_oldest(self, source: str) -> bool:
        """End the connection of a source that has waited longest; whether there was one."""
        waiting = self._waiting.get(source)
        if not waiting:
            return False
        waiting.pop(next(iter(waiting)))()
        return True
