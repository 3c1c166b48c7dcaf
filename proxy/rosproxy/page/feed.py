"""Makes the documents of the live page while a watcher waits for documents.

A watcher is an open page, or a program that polls. With a watcher, two loops run. The first loop
reads the status and makes a document each `DOCUMENT_INTERVAL_S`. If a document takes long, the
pause grows, so that documents take at most `LARGEST_TIME_SHARE` of the time. The second loop
asks the master and the nodes in rounds (`rosproxy.doctor.collect.collect_running`), with at most
`QUESTIONS_PER_SECOND` questions a second. `LINGER_S` after the last watcher, both loops end and all
counts are dropped.

Each watcher waits for a newer document than the previous document. So a slow watcher skips
documents, and no documents queue up.
"""

import asyncio
import contextlib
import logging
import time
from collections.abc import AsyncGenerator, Awaitable, Callable, Iterator, Sequence
from functools import partial

from rosproxy.doctor.collect import collect_running
from rosproxy.net.fair_slots import FairSlots
from rosproxy.page import domain_graph
from rosproxy.page.graph_document import graph_document, relayed
from rosproxy.page.judgement import JudgedFacts, judge, topics_to_ask_about
from rosproxy.page.measures import Measures
from rosproxy.page.page_document import Json
from rosproxy.page.problem_ages import ProblemAges
from rosproxy.shared.documents.doctor_finding import DoctorFinding
from rosproxy.shared.documents.status_document import ProxyStatus
from rosproxy.shared.tasks import Tasks

log = logging.getLogger(__name__)

DOCUMENT_INTERVAL_S = 1.0
"""Seconds from one document to the next, at least."""
LARGEST_TIME_SHARE = 0.1
"""Largest share of the time for making documents."""
ROUND_INTERVAL_S = 2.0
"""Seconds from the end of a round of questions to the next round, at least."""
QUESTIONS_PER_SECOND = 100.0
"""Most questions a second, over a round and the following pause."""
QUESTIONS_PER_NODE = 6
"""Most questions to a node in a round, to compute the pause after the round."""
MOST_WATCHERS = 16
"""Watchers at the same time."""
MOST_WATCHERS_EACH = 6
"""Watchers at the same time from one address.

Chromium and Firefox open at most six connections to a server, so a browser needs no more.
"""
SETTLED_AFTER_S = 30.0
"""Seconds after which the documents of an opened page show all problems.

A connection counts as stalled only when several messages are missing.
"""
SETTLED_AFTER_ROUNDS = 2
"""Rounds after which the same holds: a pair is unconnected only if two rounds have shown that."""
LINGER_S = 10.0
"""Seconds until the loops end after the last watcher. Users reload pages, and operators poll."""


class Ended(Exception):
    """The server stops, so no more documents follow."""


class Feed:
    """Holds the newest document that ``make`` has yielded.

    The feed starts ``make`` for the first watcher, and cancels ``make`` LINGER_S after the
    last watcher.
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
        """Whether no documents are made, because there is no watcher."""
        return self._making is None

    @contextlib.contextmanager
    def watching(self, source: str) -> Iterator[None]:
        """Make documents for a watcher at an address in this context. Raises NoSlot, Ended."""
        if self._closed:
            raise Ended
        try:
            with self.watchers.slot(source):
                self._begin()
                yield
        finally:
            self._end_later()

    async def after(self, former: Json | None, within: float) -> Json | None:
        """Wait for a newer document than ``former``; None after ``within`` s. Raises Ended."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(within), self._renewed:
                await self._renewed.wait_for(lambda: self._closed or self._is_update(former))
        if self._closed:
            raise Ended
        return self._newest if self._is_update(former) else None

    async def close(self) -> None:
        """Cancel ``make``, and raise Ended in all waiting watchers."""
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
            self._ending = asyncio.get_running_loop().call_later(LINGER_S, self._end)

    def _end(self) -> None:
        if self._making:
            self._making.cancel()
        self._making = self._newest = None

    async def _keep_making(self) -> None:
        while True:
            try:
                # aclosing ends the questions to nodes at once. Otherwise the questions would go on
                # until the garbage collector finds the generator.
                async with contextlib.aclosing(self._make()) as documents:
                    async for document in documents:
                        await self._publish(document)
            except Exception:
                log.exception("the live page failed; trying again")
            await asyncio.sleep(DOCUMENT_INTERVAL_S)

    async def _publish(self, document: Json) -> None:
        if document != self._newest:
            async with self._renewed:
                self._newest = document
                self._renewed.notify_all()


class PageWatch:
    """Makes the documents of a proxy from the status, the findings and the counts."""

    def __init__(
        self,
        status: Callable[[], ProxyStatus],
        own_findings: Callable[[], Sequence[DoctorFinding]],
        admin: str,
        ages: ProblemAges,
    ) -> None:
        self._status = status
        self._own_findings = own_findings
        self._admin = admin
        self._ages = ages
        self._began = time.monotonic()
        self._rounds = 0
        self._measures = Measures()
        self._judged: JudgedFacts | None = None
        # Read only once: if the clock is set later, the times of the links stay as they are.
        self._epoch = time.time() - time.monotonic()
        # A thread reads the counters to make a document. Meanwhile the counters must not change.
        self._counting = asyncio.Lock()

    async def documents(self) -> AsyncGenerator[Json]:
        """Yield a document each DOCUMENT_INTERVAL_S or later, without an end."""
        asking = asyncio.create_task(_ask_repeatedly(self._ask))
        try:
            while True:
                began = time.monotonic()
                yield await self._document(began)
                took = time.monotonic() - began
                await asyncio.sleep(
                    max(DOCUMENT_INTERVAL_S - took, took * (1 / LARGEST_TIME_SHARE - 1))
                )
        finally:
            asking.cancel()

    async def _document(self, now: float) -> Json:
        status = self._status()
        own_findings = tuple(self._own_findings())
        judged = self._judged
        async with self._counting:
            self._measures.read_participants(domain_graph.received(status), now)
            if judged:
                self._measures.read_relays(relayed(status, judged.facts.system), now)
            # In a thread, because the document of a large graph would hold up calls of nodes.
            document = await asyncio.to_thread(
                graph_document, status, judged, self._measures, own_findings, now, self._epoch
            )
        self._ages.add_to(document, now, self._epoch, self._is_settled(now), status)
        return document

    def _is_settled(self, now: float) -> bool:
        """Whether the documents show all problems."""
        is_old = now - self._began >= SETTLED_AFTER_S
        return is_old and self._rounds >= SETTLED_AFTER_ROUNDS

    async def _ask(self) -> float:
        """Ask all nodes; return the seconds until the next round."""
        began = time.monotonic()
        status = self._status()
        facts = await collect_running(status, self._admin, partial(topics_to_ask_about, status))
        judged = await asyncio.to_thread(judge, facts, self._judged, self._status())
        async with self._counting:
            relayed_links = relayed(status, facts.system)
            self._measures.read_nodes(facts, judged.pairs.keys() | relayed_links.keys())
            self._judged = judged
        self._rounds += 1
        questions = QUESTIONS_PER_NODE * len(facts.nodes)
        return max(ROUND_INTERVAL_S, questions / QUESTIONS_PER_SECOND - (time.monotonic() - began))


async def _ask_repeatedly(ask: Callable[[], Awaitable[float]]) -> None:
    """Repeat ``ask`` without an end, also after an error. ``ask`` returns the pause in seconds."""
    pause = ROUND_INTERVAL_S
    while True:
        try:
            pause = await ask()
        except Exception:
            log.exception("the live page: asking the nodes failed; trying again")
        await asyncio.sleep(pause)
