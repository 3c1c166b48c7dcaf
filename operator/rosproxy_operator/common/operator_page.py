"""The live page of all proxies of an operator, served like the page of a proxy (`rosproxy.page`).

While a page is open, the operator requests the document of every proxy in rounds, with pauses of
`ROUND_PAUSE_S` seconds. The requests also keep the proxies collecting data. Without an open page,
the operator requests nothing. The page answers only callers on loopback, because a user with the
token of a single proxy must not see all proxies.
"""

import asyncio
import time
from collections.abc import AsyncGenerator, Awaitable, Callable, Mapping
from typing import Any

from rosproxy import __version__
from rosproxy.page.feed import Feed
from rosproxy.page.page_document import Document
from rosproxy.page.problem_ages import ProblemAges
from rosproxy.page.routes import Page
from rosproxy.page.visitors import Visitors
from rosproxy.shared.tasks import Tasks
from rosproxy_operator.common.merged_page import merged
from rosproxy_operator.common.problem import Problem

ROUND_PAUSE_S = 2.0
"""Seconds from the end of a round to the next round."""
Documents = Callable[[], Awaitable[Mapping[str, Document | str]]]
"""Requests the documents of all proxies, by proxy name. Returns a text for a failed request."""


def operator_page(
    documents: Documents,
    logs: Callable[[str], str],
    places: Callable[[], Mapping[str, str]] = dict,
    problems: Callable[[], Mapping[Problem, float]] = dict,
) -> Page:
    """Return the page. ``documents`` requests the documents of all proxies.

    ``logs`` returns the command that shows the logs of a proxy. ``places`` returns the names of
    containers or pods inside, by address. ``problems`` returns the problems of the operator, with
    the monotonic times at which the operator first saw the problems.
    """
    ages = ProblemAges()

    async def make() -> AsyncGenerator[dict[str, Any]]:
        # Read only once: otherwise rounding would change the times of the problems.
        epoch = time.time() - time.monotonic()
        is_first = True
        while True:
            proxy_documents = await documents()
            own = places(), {problem: epoch + since for problem, since in problems().items()}
            document = await asyncio.to_thread(merged, proxy_documents, __version__, logs, *own)
            ages.add_to(document, time.monotonic(), epoch, is_complete=not is_first)
            is_first = False
            yield document
            await asyncio.sleep(ROUND_PAUSE_S)

    return Page(Feed(Tasks(), make), Visitors(None, time.monotonic, local=True))
