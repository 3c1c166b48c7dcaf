"""The gate: lets the operator change the cluster only while the operator leads.

Each request that changes something passes the gate just before it is sent, in any thread. After
that, the request may still arrive late. So a deletion names the uid of the object, and some
deletions the resourceVersion. The API server refuses a second object of the same name.
"""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class Gate:
    """Lets requests pass while ``open()`` is true. Safe in any thread."""

    def __init__(self, open: Callable[[], bool] = lambda: True) -> None:
        self.open = open
        self._closed = False
        self._passing = 0
        self._changed = threading.Condition()

    @contextmanager
    def passing(self) -> Iterator[bool]:
        """Yield whether a request may be sent. Until the block ends, the request is under way."""
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
        """Let no more requests pass from now on, and wait for the requests under way.

        Return whether all requests have ended within ``seconds``.
        """
        with self._changed:
            self._closed = True
            return self._changed.wait_for(lambda: not self._passing, seconds)
