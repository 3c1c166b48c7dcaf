"""Inspections of containers, each asked for once and kept.

The engine's list answers in milliseconds whatever happens. An inspection waits until the
container's start is over, which takes 26 s with 1000 ports to publish. Nothing that is read from it
changes but the aliases, and those only with the endpoints, whose ids are in the list.
"""

import asyncio
import logging
from collections.abc import Callable, Collection, Iterable

from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.docker.client import DockerClient, Json
from rosproxy_operator.docker.engine_json import Details, read_details, signature
from rosproxy_operator.docker.errors import EngineError, Gone

log = logging.getLogger(__name__)

PATIENCE = 0.1
"""Seconds that a look waits for inspections; later ones count from the next look on."""
MOST_INSPECTIONS = 16
"""Inspections that are under way at once."""


class Inspector:
    """Keeps the details of all containers. ``late`` is called when some come after a look."""

    def __init__(self, engine: DockerClient, late: Callable[[], None]) -> None:
        self._engine, self._late = engine, late
        self._known: dict[str, tuple[object, Details]] = {}
        self._asking: dict[str, asyncio.Task[None]] = {}
        self._marks: dict[str, object] = {}
        self._turns = asyncio.Semaphore(MOST_INSPECTIONS)

    @property
    def waiting(self) -> bool:
        """Whether inspections are under way, which are going to be told."""
        return bool(self._asking)

    def get(self, container: str) -> Details | None:
        """The last known details of a container, by id; None if there are none yet."""
        known = self._known.get(container)
        return known[1] if known else None

    def fresh(self, container: str) -> bool:
        """Whether a container's details are those of the state in which the list showed it."""
        known = self._known.get(container)
        return known is not None and known[0] == self._marks.get(container)

    async def update(
        self, rows: Iterable[Json], always: Collection[str] = (), patience: float = PATIENCE
    ) -> None:
        """Inspect what is new or has changed among the containers in the list.

        ``always`` are the ids of those that may have been started anew without a trace in the list.
        """
        self._marks = {
            row["Id"]: object() if row["Id"] in always else signature(row) for row in rows
        }
        self._known = {key: known for key, known in self._known.items() if key in self._marks}
        asked = []
        for key, mark in self._marks.items():
            if key not in self._asking and not self.fresh(key):
                self._asking[key] = asyncio.create_task(self._inspect(key, mark))
                asked.append(self._asking[key])
        if asked:
            _, late = await asyncio.wait(asked, timeout=patience)
            for task in late:
                task.add_done_callback(lambda _: self._late())

    async def _inspect(self, container: str, mark: object) -> None:
        try:
            async with self._turns:
                inspected = await in_thread(self._engine.container, container)
            self._known[container] = mark, read_details(inspected)
        except Gone:
            pass
        except EngineError as error:
            log.debug("inspecting %s: %s", container[:12], error)
        finally:
            del self._asking[container]
