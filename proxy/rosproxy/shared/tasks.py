"""Background tasks that never fail silently, and long work in turns."""

import asyncio
import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Iterable
from typing import Any, TypeVar

log = logging.getLogger(__name__)
_T = TypeVar("_T")


async def in_turns(items: Iterable[_T], per_turn: int) -> AsyncIterator[_T]:
    """The items. After each ``per_turn`` items, the event loop does other work."""
    for number, item in enumerate(items, start=1):
        yield item
        if number % per_turn == 0:
            await asyncio.sleep(0)


class Tasks:
    """Creates background tasks, keeps references to the tasks, and logs failures.

    asyncio itself keeps only weak references to tasks.
    """

    def __init__(self) -> None:
        self._tasks: set[asyncio.Task[Any]] = set()

    def spawn(self, work: Coroutine[Any, Any, Any], name: str) -> asyncio.Task[Any]:
        """Run ``work`` in the background; a failure is logged with ``name``."""
        task = asyncio.get_running_loop().create_task(work, name=name)
        self._tasks.add(task)
        task.add_done_callback(self._done)
        return task

    def repeat(self, step: Callable[[], Awaitable[None]], interval: float, name: str) -> None:
        """Run ``step`` for ever, with pauses of ``interval`` seconds, also after a failure."""
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
        """Cancel all tasks except the current task, and wait for the end of all."""
        tasks = [task for task in self._tasks if task is not asyncio.current_task()]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def _done(self, task: asyncio.Task[Any]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and task.exception():
            log.error("%s failed", task.get_name(), exc_info=task.exception())
