"""The live page of all proxies of an operator, served as a proxy's own is (`rosproxy.page`).

While somebody looks, every proxy is asked for its document each `EVERY` seconds, which keeps it
looking; when nobody does, none is asked. It is for callers on loopback: who may look at one proxy
may not therefore look at all.
"""

import asyncio
import time
from collections.abc import AsyncGenerator, Awaitable, Callable, Mapping
from typing import Any

from rosproxy import __version__
from rosproxy.net.tasks import Tasks
from rosproxy.page.feed import Feed
from rosproxy.page.page_document import Document
from rosproxy.page.routes import Page
from rosproxy.page.visitors import Visitors
from rosproxy_operator.common.merged_page import merged

EVERY = 2.0
"""Seconds between two rounds."""
Documents = Callable[[], Awaitable[Mapping[str, Document | str]]]


def operator_page(documents: Documents, logs: Callable[[str], str]) -> Page:
    """The page over what ``documents`` asks of the proxies, by their names; ``logs``: `merged`."""

    async def make() -> AsyncGenerator[dict[str, Any]]:
        while True:
            proxy_documents = await documents()
            yield await asyncio.to_thread(merged, proxy_documents, __version__, logs)
            await asyncio.sleep(EVERY)

    return Page(Feed(Tasks(), make), Visitors(None, time.monotonic, local=True))
