"""Which callers may use the master port, which is for nodes inside alone.

`rosproxy.ros1.registry.client_kinds` decides by the source address of a connection, before the
proxy reads the body of a call. Programs on the proxy's own machine may always use the port.

An operator reports a container some tenths of a second after the start of the container, and the
first call of the container may come earlier. So a call from an address that is not selected waits
for an update, up to UPDATE_TIMEOUT. Right after a start of the proxy, no address is selected yet.
If an operator manages the proxy, all calls wait for the first update, up to UPDATE_TIMEOUT. If no
update comes, the proxy serves all inside networks, so that nodes work without the operator
(`Callers.await_operator`).

A refused call gets HTTP 403 with the reason, not an XML-RPC fault. roscpp takes a fault for the
master's final answer and never asks again (master.cpp, execute). After an answer that is no XML-RPC
reply, roscpp tries again, and so does rospy. So a node whose container is selected later still
registers.
"""

import asyncio
import logging
from collections import Counter
from collections.abc import Iterable

from rosproxy.ros1.context import Context
from rosproxy.ros1.registry import client_kinds
from rosproxy.ros1.registry.client_kinds import ClientKind
from rosproxy.shared.addresses import is_loopback
from rosproxy.shared.machine.interfaces import is_own

log = logging.getLogger(__name__)

UPDATE_TIMEOUT = 3.0
"""The longest time in seconds that a call waits for an update that selects its source."""
MOST_WAITING = 512
"""The highest number of waiting calls. The proxy refuses further calls at once. A node makes one
call at a time, so this is the number of nodes that may start within the same seconds."""
MOST_WAITING_EACH = 64
"""The highest number of waiting calls of one source, so that no source takes all places."""
LOG_INTERVAL_S = 10.0
"""Seconds between two log lines about refused callers."""
SUBJECT = "master port"
"""The subject of the log lines and the problems about refused callers."""


class Callers:
    """Decides which callers may use the master port."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._update = asyncio.Event()
        self._begun = asyncio.Event()
        """Set once the proxy judges callers. Until then callers wait."""
        if not context.settings.admin_token_hash:
            self._begun.set()
        self._waiting = Counter[str]()
        self._logged: float | None = None

    def select(self, addresses: Iterable[str]) -> None:
        """Replace the addresses that an operator has selected."""
        self._context.selected = frozenset(addresses)
        self._begun.set()
        self._context.problems.solved(SUBJECT)
        # Wake the calls that wait now. Later calls wait for the next update.
        update = self._update
        self._update = asyncio.Event()
        update.set()

    async def await_operator(self) -> None:
        """Make callers wait for the first update of an operator, up to UPDATE_TIMEOUT from now on.

        Operators start proxies with the hash of a token. Without this hash, callers do not wait.
        """
        try:
            async with asyncio.timeout(UPDATE_TIMEOUT):
                await self._begun.wait()
        except TimeoutError:
            log.info("no operator has selected addresses yet: the proxy serves all inside networks")
            self._begun.set()

    async def wait_until_begun(self) -> None:
        """Wait as long as callers have to wait after a start; see `await_operator`."""
        await self._begun.wait()

    async def refusal(self, source: str) -> str | None:
        """Why a caller is refused, in one line; None if the caller may use the port.

        The answer may take up to twice UPDATE_TIMEOUT.
        """
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

        The method returns at once if too many callers wait. It also does so if the admin endpoint
        is on loopback and no update has come yet, because then there is no operator.
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
        context.problems.solved(SUBJECT)  # only the last refusal stays: there may be any number
        context.problems.add(SUBJECT, text)
        if self._logged is None or now - self._logged >= LOG_INTERVAL_S:
            self._logged = now
            log.warning("%s: refused: %s", SUBJECT, text)
