"""Logging to standard error, for people as text or for machines as one JSON object per line.

A call may name its object by ``extra=`` (``node``, ``port``, ``container`` or ``proxy``), such as
``log.info("...", extra={"node": "/talker", "port": 45000})``. JSON lines have these fields beside
``time`` (ISO 8601, UTC), ``level``, ``logger``, ``message`` and, with a traceback, ``error``. Text
lines have the time, the level, the message and the traceback, but no fields of ``extra``.

Messages quote nodes, labels and documents, which may be hostile. This module makes all messages
harmless. A message is a line of at most LONGEST characters, without characters that move the cursor
or reorder text (`harmless`). The count of left-out messages may follow. Repeated messages do not
fill the disk (`LogRateLimit`). Tracebacks stay the same, except the texts of the exceptions.
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

from rosproxy.shared.output.problems import LONGEST_SUBJECT
from rosproxy.shared.output.text import brief, clean

LONGEST = 2000
"""Most characters of a message, and of the text of an exception. The proxy's own messages have up
to 400."""
SUBJECT_BURST = 20
"""Warnings and errors of one kind about one subject that are written in a burst. A real node causes
a few messages a minute at most. A subject can be an address: 20 is four nodes there, with five
topics each."""
SUBJECT_INTERVAL_S = 5.0
"""Seconds after a burst until one more message about the subject is written."""
KIND_BURST = 2000
"""Messages of one kind that are written in a burst. 1,000 nodes that start at once use half of
these, with a line for each node."""
KIND_INTERVAL_S = 1.0
"""Seconds after a burst until one more message of the kind is written."""
USUAL_CHARACTERS = 200
"""For each 200 characters, a message counts one more time."""
MOST_BUCKETS = 1024
"""Buckets of kinds, and as many buckets of subjects. A further bucket of a kind replaces the bucket
of a kind that was unused for longest. So made-up subjects replace no bucket of a kind."""

_NAMES = {"levelname": "level", "name": "logger", "exc_info": "error"}


@dataclass(slots=True)
class _Bucket:
    """A token bucket: ``remaining`` messages at the time ``since``, and messages left out."""

    remaining: float
    since: float
    left_out: int = 0


class LogRateLimit(logging.Filter):
    """Leaves out messages that come too often; the next message of the kind says how many.

    Messages of one kind come from the same call: logger, level and template are the same. The
    subject is the first argument of the template. Each kind has a bound. Warnings and errors of a
    kind about one subject have a lower bound. Long messages count several times.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._clock = clock
        self._lock = threading.Lock()  # the threads of relays log, too
        self._kinds: dict[Hashable, _Bucket] = {}
        self._subjects: dict[Hashable, _Bucket] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether to write a record. Sets ``left_out`` if records before it were left out."""
        kind = record.name, record.levelno, str(record.msg)[:LONGEST]
        weight = 1 + min(len(record.getMessage()), LONGEST) // USUAL_CHARACTERS
        with self._lock:
            if record.levelno >= logging.WARNING:
                key = *kind, _subject(record)
                bucket = self._bucket(self._subjects, key, SUBJECT_BURST, SUBJECT_INTERVAL_S)
                if not _take(bucket, record, weight):
                    return False
            bucket = self._bucket(self._kinds, kind, KIND_BURST, KIND_INTERVAL_S)
            return _take(bucket, record, weight)

    def _bucket(
        self, buckets: dict[Hashable, _Bucket], key: Hashable, burst: int, interval: float
    ) -> _Bucket:
        """The bucket of a key, refilled: one message for each ``interval`` (s), up to ``burst``."""
        now = self._clock()
        bucket = buckets.pop(key, None) or _Bucket(burst, now)
        if len(buckets) >= MOST_BUCKETS:
            del buckets[next(iter(buckets))]
        buckets[key] = bucket  # at the end: the first bucket was unused for longest
        bucket.remaining = min(bucket.remaining + (now - bucket.since) / interval, burst)
        bucket.since = now
        return bucket


def _take(bucket: _Bucket, record: logging.LogRecord, weight: int) -> bool:
    """Whether a bucket allows a record. Moves the count of left-out messages to the record.

    The count of a record that is left out goes to the bucket.
    """
    left_out = getattr(record, "left_out", 0)
    if bucket.remaining < 1:
        bucket.left_out += left_out + 1
        return False
    bucket.remaining -= weight
    if bucket.left_out:
        record.left_out = left_out + bucket.left_out
        bucket.left_out = 0
    return True


def _subject(record: logging.LogRecord) -> str:
    """The subject of a record: the first argument; empty without arguments."""
    arguments = record.args if isinstance(record.args, tuple) else ()
    return brief(arguments[0], LONGEST_SUBJECT) if arguments else ""


def harmless(record: logging.LogRecord) -> logging.LogRecord:
    """A copy of a record with a message and a traceback that are harmless on a terminal."""
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
    """Formats a record as a line of JSON, with the fields of the module's docstring."""

    def __init__(self) -> None:
        super().__init__(["levelname", "name", "message"], rename_fields=_NAMES, timestamp="time")

    def format(self, record: logging.LogRecord) -> str:
        """The line."""
        return super().format(harmless(record))

    def process_log_record(self, log_data: dict[str, Any]) -> dict[str, Any]:
        """The fields with harmless texts, and with the level in lower case."""
        fields = {
            name: brief(field, LONGEST)
            if isinstance(field, str) and name not in _HARMLESS_FIELDS
            else field
            for name, field in log_data.items()
        }
        return {**fields, "level": log_data["level"].lower()}


_HARMLESS_FIELDS = frozenset({"message", "error"})
"""The fields that `harmless` has made harmless. A further `brief` would join the lines of a
traceback, and could cut the count of left-out messages."""


def set_up(form: str, level: str) -> None:
    """Log to standard error in ``form`` (text or json), from ``level`` up."""
    handler = logging.StreamHandler()
    handler.setFormatter(JsonLines() if form == "json" else TextLines())
    # At the handler: the filter of a logger does not see the records of loggers below.
    handler.addFilter(LogRateLimit())
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)
    # aiohttp logs a caller that sends no HTTP as an error. This is no error of the proxy.
    logging.getLogger("aiohttp.server").setLevel(logging.CRITICAL)


def _traceback(record: logging.LogRecord) -> str | None:
    """The traceback of a record, with each exception text on a single line."""
    if not record.exc_info or record.exc_info[1] is None:
        return None
    text = logging.Formatter().formatException(record.exc_info)
    for error in _chain(record.exc_info[1]):
        message = ""
        with contextlib.suppress(Exception):  # __str__ may raise; the traceback then says so
            message = str(error)
        if message:
            text = text.replace(message, brief(message, LONGEST))
    return "\n".join(map(clean, text.split("\n")))


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    """An exception, with its causes and contexts."""
    visited: set[int] = set()
    while error is not None and id(error) not in visited:
        visited.add(id(error))
        yield error
        error = error.__cause__ or error.__context__
