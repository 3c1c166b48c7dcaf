"""Logging to standard error, for people as text or for machines as one JSON object per line.

A call says what it is about by ``extra=``: ``node``, ``port``, ``container`` or ``proxy``, where
that is known, for example ``log.info("...", extra={"node": "/talker", "port": 45000})``. JSON lines
have these as fields of their own beside ``time`` (ISO 8601, UTC), ``level``, ``logger``,
``message`` and, with a traceback, ``error``; text lines have the message alone.

Messages quote what nodes, labels and documents say, and those may be hostile. So this is the one
place that makes them harmless, whoever logs: a message is one line of at most LONGEST characters
without anything that moves a cursor or reorders text (`harmless`); and who makes the proxy say the
same again and again does not fill the disk (`LogRateLimit`). Tracebacks stay as they are, but for
the texts of the exceptions in them.
"""

import contextlib
import copy
import logging
import threading
import time
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass
from typing import Any

from pythonjsonlogger.json import JsonFormatter

from rosproxy.telemetry.problems import LONGEST_SUBJECT
from rosproxy.telemetry.text import brief, clean

LONGEST = 2000
"""Characters of a message at most, and of each exception's text: the longest of the proxy's own
has some 400."""
SUBJECT_BURST = 20
SUBJECT_INTERVAL = 5.0
"""Warnings and errors of one kind about one subject that are written at once, and the seconds
after which one more is. What is told of a real node changes a few times in a minute at most; where
the subject is an address, there may be some nodes that each say the same of five topics."""
KIND_BURST = 2000
KIND_INTERVAL = 1.0
"""The same for all messages of one kind: a thousand nodes that start at once have a line each."""
USUAL = 200
"""Characters of a message that counts as one; a longer one counts as several."""
MOST_BUCKETS = 1024
"""Kinds and subjects that are remembered; of more the one that came last the longest ago goes."""

_NAMES = {"levelname": "level", "name": "logger", "exc_info": "error"}


@dataclass(slots=True)
class _Bucket:
    """Messages that may still be written, as of ``since``, and how many were left out."""

    remaining: float
    since: float
    left_out: int = 0


class LogRateLimit(logging.Filter):
    """Leaves out messages that come too often, and says in the next of their kind how many.

    Messages are of one kind if they come from the same call: logger, level and template are the
    same; the subject is the template's first argument. Each kind has a bound, and warnings
    and errors about one subject have a lower one; long messages use both up sooner. Debug messages
    are for somebody who looks on: they are all written.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._clock = clock
        self._lock = threading.Lock()  # relays log from threads of their own
        self._buckets: dict[Hashable, _Bucket] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether to write a record; it then has ``left_out``, if others were before it."""
        if record.levelno < logging.INFO:
            return True
        kind = record.name, record.levelno, str(record.msg)[:LONGEST]
        weight = 1 + min(len(record.getMessage()), LONGEST) // USUAL
        with self._lock:
            if record.levelno >= logging.WARNING:
                bucket = self._bucket((*kind, _subject(record)), SUBJECT_BURST, SUBJECT_INTERVAL)
                if not _take(bucket, record, weight):
                    return False
            return _take(self._bucket(kind, KIND_BURST, KIND_INTERVAL), record, weight)

    def _bucket(self, key: Hashable, burst: int, every: float) -> _Bucket:
        """What is left of a bound by now."""
        now = self._clock()
        bucket = self._buckets.pop(key, None) or _Bucket(burst, now)
        if len(self._buckets) >= MOST_BUCKETS:
            del self._buckets[next(iter(self._buckets))]
        self._buckets[key] = bucket  # the last, so that the first is unused for the longest time
        bucket.remaining = min(bucket.remaining + (now - bucket.since) / every, burst)
        bucket.since = now
        return bucket


def _take(bucket: _Bucket, record: logging.LogRecord, weight: int) -> bool:
    """Whether a bound allows one more record, which then tells what was left out before."""
    if bucket.remaining < 1:
        bucket.left_out += 1
        return False
    bucket.remaining -= weight
    if bucket.left_out:
        record.left_out = getattr(record, "left_out", 0) + bucket.left_out
        bucket.left_out = 0
    return True


def _subject(record: logging.LogRecord) -> str:
    """What a record is about: the first of its arguments; without any it is its template."""
    arguments = record.args if isinstance(record.args, tuple) else ()
    return brief(arguments[0], LONGEST_SUBJECT) if arguments else ""


def harmless(record: logging.LogRecord) -> logging.LogRecord:
    """A copy of a record whose message and traceback may be written as they are."""
    safe = copy.copy(record)
    safe.msg = brief(record.getMessage(), LONGEST)
    safe.args = None
    left_out = getattr(record, "left_out", 0)
    if left_out:
        safe.msg += f" ({left_out} more like it were left out)"
    safe.exc_text = _traceback(record)
    safe.exc_info = None
    return safe


class TextLines(logging.Formatter):
    """Formats a record as a line of text, with a traceback below it if there is one."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname)-7s %(message)s")

    def format(self, record: logging.LogRecord) -> str:
        """The line."""
        return super().format(harmless(record))


class JsonLines(JsonFormatter):
    """Formats a record as JSON, with the fields above."""

    def __init__(self) -> None:
        super().__init__(["levelname", "name", "message"], rename_fields=_NAMES, timestamp="time")

    def format(self, record: logging.LogRecord) -> str:
        """The line."""
        return super().format(harmless(record))

    def process_log_record(self, log_data: dict[str, Any]) -> dict[str, Any]:
        """The fields, texts among them harmless, with the level in lower case."""
        fields = {
            name: brief(field, LONGEST) if isinstance(field, str) and name not in _SAFE else field
            for name, field in log_data.items()
        }
        return {**fields, "level": log_data["level"].lower()}


_SAFE = frozenset({"message", "error"})
"""What `harmless` has made safe: a traceback has lines, the message may tell what was left out."""


def set_up(form: str, level: str) -> None:
    """Log to standard error in ``form`` (text or json) from ``level`` on."""
    handler = logging.StreamHandler()
    handler.setFormatter(JsonLines() if form == "json" else TextLines())
    # At the handler: a logger's filter does not see what the loggers below it log.
    handler.addFilter(LogRateLimit())
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)
    # Strangers that speak no HTTP are not errors of ours.
    logging.getLogger("aiohttp.server").setLevel(logging.CRITICAL)


def _traceback(record: logging.LogRecord) -> str | None:
    """A record's traceback, in which the exceptions' texts begin no lines of their own."""
    if not record.exc_info or record.exc_info[1] is None:
        return None
    text = logging.Formatter().formatException(record.exc_info)
    for error in _chain(record.exc_info[1]):
        message = ""
        with contextlib.suppress(Exception):  # its own __str__ may fail; Python copes with that
            message = str(error)
        if message:
            text = text.replace(message, brief(message, LONGEST))
    return "\n".join(map(clean, text.split("\n")))


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    """An exception and all that led to it."""
    visited: set[int] = set()
    while error is not None and id(error) not in visited:
        visited.add(id(error))
        yield error
        error = error.__cause__ or error.__context__
