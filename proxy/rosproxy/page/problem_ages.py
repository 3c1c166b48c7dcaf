"""The times since which the problems of the live page are there.

The proxy notices some problems without a page, and its status has their ages. All other problems
are first seen while a page is open. A problem in the first documents of an opened page may be older
than the page. The process of a proxy or an operator keeps these times, also while no page is open.
A new process begins anew. Times are monotonic seconds.
"""

import re
from collections.abc import Iterable
from typing import NamedTuple

from rosproxy.page.graph_document import MASTER
from rosproxy.page.judgement import inside_nodes
from rosproxy.page.page_document import BROKEN, WARNING, Json, shown_name
from rosproxy.page.zenoh_graph import router_key
from rosproxy.shared.documents.status_document import ProxyStatus
from rosproxy.shared.output.text import brief

NOTICED_WITHIN_S = 30.0
"""Seconds in which the proxy itself notices a problem that an open page shows at once."""
_WRONG = frozenset({WARNING, BROKEN})
_Key = tuple[str, str, str]
"""A problem: the table, the key of the row, and the state. A finding has no key in the document, so
its subject and text stand for the key. Without digits: a count in the text may grow."""


class _Beginning(NamedTuple):
    """When a problem was first seen, and whether it may be older."""

    at: float
    may_be_older: bool


class ProblemAges:
    """The time at which each problem was first seen."""

    def __init__(self) -> None:
        self._newest: dict[_Key, _Beginning] = {}
        self._complete: dict[_Key, _Beginning] = {}

    def add_to(
        self,
        document: Json,
        now: float,
        epoch: float,
        is_complete: bool,
        status: ProxyStatus | None = None,
    ) -> None:
        """Set ``wrong_since`` and ``may_be_older`` in each row with a problem without a time.

        An operator also replaces a time in the future: the clock of the proxy's host is ahead.

        ``epoch``: the Unix time in seconds at which the monotonic clock was 0. ``status``: of the
        proxy, from the same moment as the ``document``. A problem keeps its time if the previous
        document has the problem. The first documents of an opened page may lack problems. So a
        problem of the last document with ``is_complete`` also keeps its time.
        """
        noticed = _Noticed(status or ProxyStatus())
        current: dict[_Key, _Beginning] = {}
        for key, row in _problems(document):
            seen = self._newest.get(key) or self._complete.get(key)
            age = noticed.age(key, row)
            current[key] = beginning = (
                seen or _Beginning(now, may_be_older=not is_complete)
                if age is None
                else _noticed_at(now - age, seen)
            )
            known = row.get("wrong_since")
            if known is None or known > epoch + now + 1.0:
                row["wrong_since"] = round(epoch + beginning.at)
                if beginning.may_be_older:
                    row["may_be_older"] = True
        self._newest = current
        if is_complete:
            self._complete = current


def _noticed_at(at: float, seen: _Beginning | None) -> _Beginning:
    """The beginning of a problem that the proxy noticed ``at`` a time, and a page has ``seen``.

    The page may be earlier by some seconds. Ages in the status are rounded, so a time close to the
    former time is the former time.
    """
    is_same = seen is not None and abs(seen.at - at) < NOTICED_WITHIN_S
    return _Beginning(seen.at if seen and is_same else at, may_be_older=False)


class _Noticed:
    """The ages in seconds of problems that the proxy has noticed without a page."""

    def __init__(self, status: ProxyStatus) -> None:
        self._problems = status.problems
        self._nodes = {MASTER: status.master.since}
        for name, endpoint in inside_nodes(status).items():
            if endpoint.unanswered:
                self._nodes[shown_name(name)] = endpoint.unanswered
        for link in status.zenoh.links if status.zenoh else ():
            if not link.up:
                self._nodes[router_key(link)] = link.since

    def age(self, key: _Key, row: Json) -> float | None:
        """The age of the problem in a row; None if the proxy has not noticed the problem.

        The proxy notes a problem with the text and the fix as a single text. The key of the row, or
        the subject of the finding, has the noted subject.
        """
        table, name, _ = key
        if table == "nodes" and name in self._nodes:
            return self._nodes[name]
        text = row.get("text", "")
        fix = row.get("fix", "")
        texts = (text, f"{text}. {fix}", f"{text}. Fix: {fix}")
        ages = [
            problem.known_for
            for problem in self._problems
            if problem.subject in name and _is_among(problem.text, texts)
        ]
        return max(ages, default=None)


def _is_among(noted: str, texts: Iterable[str]) -> bool:
    """Whether ``noted``, which is shortened if it was too long, stands for one of the texts."""
    return bool(noted) and any(brief(text, len(noted)) == noted for text in texts)


def _problems(document: Json) -> list[tuple[_Key, Json]]:
    rows = [
        ((table, key, row["state"]), row)
        for table in ("nodes", "links")
        for key, row in document[table].items()
        if row.get("state") in _WRONG
    ]
    findings = document["findings"]
    return rows + [(("findings", _shape(f), f["severity"]), f) for f in findings]


def _shape(finding: Json) -> str:
    return f"{finding['subject']}: {re.sub(r'[0-9]+', '', finding['text'])}"
