"""Lets the operator write while it leads, and not a moment longer.

Every request that changes something passes here just before it is sent, from whichever thread. One
that was sent may still arrive late: so deletions name what they are for (uid, resourceVersion), and
to create an object twice is refused by its name.
"""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class Gate:
    """Lets requests through while ``open`` says so. Any thread may use it."""

    def __init__(self, open: Callable[[], bool] = lambda: True) -> None:
        self.open = open
        self._closed = False
        self._passing = 0
        self._changed = threading.Condition()

    @contextmanager
    def passing(self) -> Iterator[bool]:
        """Whether a request may be sent, which counts as under way until this ends."""
        with self._changed:
            may_pass = not self._closed and self.open()
            self._passing += may_pass
        try:
            yield may_pass
        finally:
            with self._changed:
                self._passing -= may_pass
                self._changed.notify_all()

    def close(self, seconds: float) -> bool:
        """Let nothing through any more; whether all that was under way has ended by then."""
        with self._changed:
            self._closed = True
            return self._changed.wait_for(lambda: not self._passing, seconds)
