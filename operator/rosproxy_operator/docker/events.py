"""The engine's events. Each says no more than: look again."""

import asyncio
import contextlib
import threading
import time
from collections.abc import Callable

from rosproxy_operator.docker.client import DockerClient
from rosproxy_operator.docker.errors import EngineError

FILTERS = {
    "type": ["container", "network", "image"],
    "event": [
        *("create", "start", "die", "destroy", "pause", "unpause", "rename"),
        *("connect", "disconnect"),
        *("tag", "untag", "pull", "load", "import", "delete"),
    ],
}
"""What may change a plan. Health checks and ``docker exec`` are told often and change nothing."""
PAUSES = (0.2, 0.5, 1.0, 2.0, 5.0)
"""Seconds between attempts to listen again; the last one is repeated."""


class Events:
    """Listens to an engine for good, in a thread of its own.

    ``changed`` is called in the event loop when something has; ``connected`` after each connect:
    the engine is there, and what happened before that was missed.
    """

    def __init__(
        self, engine: DockerClient, connected: Callable[[], None], changed: Callable[[], None]
    ) -> None:
        self._engine, self._connected, self._changed = engine, connected, changed

    def start(self) -> None:
        """Begin. Needs a running event loop."""
        loop = asyncio.get_running_loop()
        threading.Thread(target=self._listen, args=(loop,), daemon=True, name="events").start()

    def _listen(self, loop: asyncio.AbstractEventLoop) -> None:
        failures = 0
        while not loop.is_closed():
            with contextlib.suppress(EngineError):  # the looks tell of it
                events = self._engine.events(FILTERS)
                failures = 0
                _call(loop, self._connected)
                for _ in events:
                    _call(loop, self._changed)
            time.sleep(PAUSES[min(failures, len(PAUSES) - 1)])
            failures += 1


def _call(loop: asyncio.AbstractEventLoop, function: Callable[[], None]) -> None:
    with contextlib.suppress(RuntimeError):  # the loop has been closed meanwhile
        loop.call_soon_threadsafe(function)
