"""Who is let in at the master port, which is for inside nodes alone.

`rosproxy.ros1.registry.client_kinds` decides by the address that a connection comes from, before
anything that it sends is read. Programs on the proxy's own machine are always let in.

An operator tells of a container some tenths of a second after its start, and the container's first
call may be faster. So a call from an address that is not selected waits for an update, up to
UPDATE_TIMEOUT. Right after a start nobody is known to be selected yet: where an operator runs, all
calls wait for its first word, up to UPDATE_TIMEOUT, and are let in if none comes, so that an
operator that is away stops nobody (`Callers.await_operator`).

What is refused gets HTTP 403 with the reason, not an XML-RPC fault: roscpp takes a fault for the
master's last word and never asks again (master.cpp, execute), but goes on trying after anything
that is no XML-RPC reply, as rospy does. So a node whose container is selected later still comes to
register.
"""

import asyncio
import logging
from collections import Counter
from collections.abc import Iterable

from rosproxy.net.addresses import is_loopback
from rosproxy.net.interfaces import is_own
from rosproxy.ros1.context import Context
from rosproxy.ros1.registry import client_kinds
from rosproxy.ros1.registry.client_kinds import ClientKind

log = logging.getLogger(__name__)

UPDATE_TIMEOUT = 3.0
"""Seconds that a call waits at most for an update that selects its source."""
MOST_WAITING = 512
"""Calls that wait for an update at once; beyond that they are refused without. A node makes one
call at a time, so that these are as many nodes that start in the same seconds."""
MOST_WAITING_EACH = 64
"""The same for one source: nobody takes all places."""
LOG_INTERVAL = 10.0
"""Seconds between two log lines about refused callers."""
SUBJECT = "master port"


class Callers:
    """Lets callers in, or says why not."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._update = asyncio.Event()
        self._begun = asyncio.Event()
        """Set once callers are judged; until then they wait."""
        if not context.settings.admin_token_hash:
            self._begun.set()
        self._waiting = Counter[str]()
        self._logged: float | None = None

    def select(self, addresses: Iterable[str]) -> None:
        """Take in which addresses an operator has selected, instead of those before."""
        self._context.selected = frozenset(addresses)
        self._begun.set()
        self._context.problems.solved(SUBJECT)
        # Calls that wait now are woken; later calls wait for the next update.
        update = self._update
        self._update = asyncio.Event()
        update.set()

    async def await_operator(self) -> None:
        """Have callers wait for an operator's first word, for UPDATE_TIMEOUT at most from now on.

        None is waited for without the hash of a token, by which operators start their proxies.
        """
        try:
            async with asyncio.timeout(UPDATE_TIMEOUT):
                await self._begun.wait()
        except TimeoutError:
            log.info("no operator has selected addresses yet: the proxy serves all inside networks")
            self._begun.set()

    async def wait_until_begun(self) -> None:
        """Wait as long as callers are to wait after a start; see `await_operator`."""
        await self._begun.wait()

    async def refusal(self, source: str) -> str | None:
        """Why a caller is refused, in one line; None if it is let in."""
        if not self._begun.is_set() and not is_own(source):
            await self.wait_until_begun()
        if self._client_kind(source) is ClientKind.ADMITTED:
            return None
        await self._wait_for_update(source)
        kind = self._client_kind(source)
        if kind is ClientKind.ADMITTED:
            return None
        text = client_kinds.refusal(source, kind, self._context.addressing.networks)
        self._report(text, kind)
        return text

    def _client_kind(self, source: str) -> ClientKind:
        self._context.refresh_networks()
        kind = self._context.client_kind(source)
        if kind is not ClientKind.ADMITTED and is_own(source):
            return ClientKind.ADMITTED
        return kind

    async def _wait_for_update(self, source: str) -> None:
        """Wait until an operator has selected a source, up to UPDATE_TIMEOUT.

        No operator is heard where the admin endpoint is on loopback, if none was heard so far.
        """
        no_update = self._context.selected is None and is_loopback(
            self._context.settings.admin.host
        )
        waiting = self._waiting
        if no_update or waiting.total() >= MOST_WAITING or waiting[source] >= MOST_WAITING_EACH:
            return
        waiting[source] += 1
        try:
            async with asyncio.timeout(UPDATE_TIMEOUT):
                while self._client_kind(source) is not ClientKind.ADMITTED:
                    await self._update.wait()
        except TimeoutError:
            log.debug("no operator has selected %s in time", source)
        finally:
            waiting[source] -= 1
            if not waiting[source]:
                del waiting[source]

    def _report(self, text: str, kind: ClientKind) -> None:
        context = self._context
        now = self._context.now()
        context.metrics.strangers.labels(kind.value).inc()
        context.problems.solved(SUBJECT)  # the last one is enough: there may be any number
        context.problems.add(SUBJECT, text)
        if self._logged is None or now - self._logged >= LOG_INTERVAL:
            self._logged = now
            log.warning("%s: refused: %s", SUBJECT, text)
