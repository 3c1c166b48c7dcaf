"""The times since which the problems of the live page are there.

The process of a proxy or an operator keeps these times, also while no page is open. A new process
begins anew. Times are monotonic seconds.
"""

import re

from rosproxy.page.page_document import BROKEN, WARNING, Json

_WRONG = frozenset({WARNING, BROKEN})
_Key = tuple[str, str, str]
"""A problem: the table, the key of the row, and the state. A finding has no key in the document, so
its subject and text stand for the key. Without digits: a count in the text may grow."""


class ProblemAges:
    """The time at which each problem was first seen."""

    def __init__(self) -> None:
        self._newest: dict[_Key, float] = {}
        self._complete: dict[_Key, float] = {}

    def add_to(self, document: Json, now: float, epoch: float, is_complete: bool) -> None:
        """Set ``wrong_since`` in each row with a problem that has no such time.

        An operator also replaces a time in the future: the clock of the proxy's host is ahead.

        ``epoch``: the Unix time in seconds at which the monotonic clock was 0. A problem keeps its
        time if the previous document has the problem. The first documents of an opened page may
        lack problems. So a problem of the last document with ``is_complete`` also keeps its time.
        """
        current: dict[_Key, float] = {}
        for key, row in _problems(document):
            current[key] = self._newest.get(key, self._complete.get(key, now))
            known = row.get("wrong_since")
            if known is None or known > epoch + now + 1.0:
                row["wrong_since"] = round(epoch + current[key])
        self._newest = current
        if is_complete:
            self._complete = current


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
