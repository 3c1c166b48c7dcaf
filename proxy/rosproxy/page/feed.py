"""Keeps the document up to date for as long as somebody looks at it, and hands out what is new.

While there is a watcher, two things go on. The status is read each `TICK` seconds, later where that
takes long, so that the page never costs more than a share of the proxy's time. And the master and
the nodes are asked (`rosproxy.doctor.collect.collect_running`), so many questions a second at most.
When nobody looks, nobody is asked, and what was counted is forgotten.

A watcher waits for another document than the one that it has. One that is slow thereby skips those
between, and nothing queues up for it.
"""

import asyncio
import contextlib
import logging
import time
from collections.abc import AsyncGenerator, Awaitable, Callable, Iterator, Sequence
from functools import partial

from rosproxy.admin.doctor_finding import DoctorFinding
from rosproxy.admin.status_document import ProxyStatus
from rosproxy.doctor.collect import collect_running
from rosproxy.net.fair_slots import FairSlots
from rosproxy.net.tasks import Tasks
from rosproxy.page.graph_document import graph_document, relayed
from rosproxy.page.judgement import JudgedFacts, judge, topics_to_ask_about
from rosproxy.page.measures import Measures
from rosproxy.page.page_document import Json

log = logging.getLogger(__name__)

TICK = 1.0
"""Seconds between two documents at least."""
SHARE = 0.1
"""Share of the time that is spent on making documents at most."""
LOOK_AGAIN = 2.0
"""Seconds between two rounds of questions at least."""
PER_SECOND = 100.0
"""Questions a second at most, over a round and the pause after it."""
PER_NODE = 6
"""Questions to each node in a round at most."""
MOST_WATCHERS = 16
"""Pages that are open at the same time."""
MOST_WATCHERS_EACH = 6
"""The same from one address. Chromium and Firefox have six connections to a server at most, so that
a person with many tabs has no more in any case."""
LINGER = 10.0
"""Seconds for which it goes on after the last watcher: pages are loaded again, operators poll."""


class Ended(Exception):
    """The server stops, and there are no more documents."""


class Feed:
    """The newest document, made by ``make`` while there is somebody who wants it.

    ``make`` is started anew with the first watcher and cancelled after the last: it yields
    documents.
    """

    def __init__(self, tasks: Tasks, make: Callable[[], AsyncGenerator[Json]]) -> None:
        self._tasks = tasks
        self._make = make
        self.watchers = FairSlots(
            "pages are open", MOST_WATCHERS, MOST_WATCHERS_EACH, "close one of them"
        )
        self._newest: Json | None = None
        self._renewed = asyncio.Condition()
        self._making: asyncio.Task[None] | None = None
        self._ending: asyncio.TimerHandle | None = None
        self._closed = False

    @property
    def idle(self) -> bool:
        """Whether nothing is made, since nobody looks."""
        return self._making is None

    @contextlib.contextmanager
    def watching(self, source: str) -> Iterator[None]:
        """As long as this lasts, documents are made for an address. Raises NoSlot, Ended."""
        if self._closed:
            raise Ended
        try:
            with self.watchers.slot(source):
                self._begin()
                yield
        finally:
            self._end_later()

    async def after(self, former: Json | None, within: float) -> Json | None:
        """Another document than the ``former``; None if none comes ``within`` these seconds.

        Raises Ended.
        """
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(within), self._renewed:
                await self._renewed.wait_for(lambda: self._closed or self._is_update(former))
        if self._closed:
            raise Ended
        return self._newest if self._is_update(former) else None

    async def close(self) -> None:
        """Let everybody go."""
        self._closed = True
        if self._ending:
            self._ending.cancel()
        self._end()
        async with self._renewed:
            self._renewed.notify_all()

    def _is_update(self, former: Json | None) -> bool:
        return self._newest is not None and self._newest is not former

    def _begin(self) -> None:
        if self._ending:
            self._ending.cancel()
            self._ending = None
        if self._making is None or self._making.done():
            self._making = self._tasks.spawn(self._keep_making(), "the live page")

    def _end_later(self) -> None:
        if not self.watchers.taken and not self._closed:
            self._ending = asyncio.get_running_loop().call_later(LINGER, self._end)

    def _end(self) -> None:
        if self._making:
            self._making.cancel()
        self._making = self._newest = None

    async def _keep_making(self) -> None:
        while True:
            try:
                # Closed here, so that its questions to nodes end at once, and not with the garbage.
                async with contextlib.aclosing(self._make()) as documents:
                    async for document in documents:
                        await self._publish(document)
            except Exception:
                log.exception("the live page failed; trying again")
            await asyncio.sleep(TICK)

    async def _publish(self, document: Json) -> None:
        if document != self._newest:
            async with self._renewed:
                self._newest = document
                self._renewed.notify_all()


class PageWatch:
    """What was counted and found out of a proxy since somebody began to look at its page."""

    def __init__(
        self,
        status: Callable[[], ProxyStatus],
        own_findings: Callable[[], Sequence[DoctorFinding]],
        admin: str,
    ) -> None:
        self._status = status
        self._own_findings = own_findings
        self._admin = admin
        self._measures = Measures()
        self._judged: JudgedFacts | None = None
        # Taken once: were the clock set meanwhile, the times of all links would change.
        self._epoch = time.time() - time.monotonic()
        # A document is made in a thread, and counters may not change while that reads them.
        self._counting = asyncio.Lock()

    async def documents(self) -> AsyncGenerator[Json]:
        """A document each tick, without an end."""
        asking = asyncio.create_task(_again_and_again(self._ask))
        try:
            while True:
                began = time.monotonic()
                yield await self._document(began)
                took = time.monotonic() - began
                await asyncio.sleep(max(TICK - took, took * (1 / SHARE - 1)))
        finally:
            asking.cancel()

    async def _document(self, now: float) -> Json:
        status = self._status()
        own_findings = tuple(self._own_findings())
        judged = self._judged
        async with self._counting:
            if judged:
                self._measures.read_relays(relayed(status, judged.facts.system), now)
            # In a thread, so that calls of nodes are not kept waiting by a large graph.
            return await asyncio.to_thread(
                graph_document, status, judged, self._measures, own_findings, now, self._epoch
            )

    async def _ask(self) -> float:
        """One round of questions; the seconds until the next."""
        began = time.monotonic()
        status = self._status()
        facts = await collect_running(status, self._admin, partial(topics_to_ask_about, status))
        judged = await asyncio.to_thread(judge, facts, self._judged, self._status())
        async with self._counting:
            relayed_links = relayed(status, facts.system)
            self._measures.read_nodes(facts, judged.pairs.keys() | relayed_links.keys())
            self._judged = judged
        questions = PER_NODE * len(facts.nodes)
        return max(LOOK_AGAIN, questions / PER_SECOND - (time.monotonic() - began))


async def _again_and_again(ask: Callable[[], Awaitable[float]]) -> None:
    """Ask without an end, whatever becomes of it."""
    pause = LOOK_AGAIN
    while True:
        try:
            pause = await ask()
        except Exception:
            log.exception("the live page: asking the nodes failed; trying again")
        await asyncio.sleep(pause)
