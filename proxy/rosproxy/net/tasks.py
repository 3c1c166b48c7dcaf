"""Background tasks that never fail silently."""

import asyncio
import logging
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any

log = logging.getLogger(__name__)


class Tasks:
    """The one place where background tasks are made: kept alive, logged when they fail."""

    def __init__(self) -> None:
        self._tasks: set[asyncio.Task[Any]] = set()

    def spawn(self, work: Coroutine[Any, Any, Any], name: str) -> asyncio.Task[Any]:
        """Run ``work`` in the background; ``name`` stands in the log if it fails."""
        task = asyncio.get_running_loop().create_task(work, name=name)
        self._tasks.add(task)
        task.add_done_callback(self._done)
        return task

    def repeat(self, step: Callable[[], Awaitable[None]], interval: float, name: str) -> None:
        """Run ``step`` again and again, ``interval`` seconds apart, whatever becomes of it."""
        self.spawn(self._repeat(step, interval, name), name)

    async def _repeat(
        self, step: Callable[[], Awaitable[None]], interval: float, name: str
    ) -> None:
        while True:
            try:
                await step()
            except Exception:
                log.exception("%s failed; trying again", name)
            await asyncio.sleep(interval)

    async def cancel(self) -> None:
        """Cancel everything and wait until it has ended."""
        tasks = [task for task in self._tasks if task is not asyncio.current_task()]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def _done(self, task: asyncio.Task[Any]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and task.exception():
            log.error("%s failed", task.get_name(), exc_info=task.exception())
