"""Logs: text and JSON, with escaped quotes of foreign texts, and bounded in a flood."""

import json
import logging
from collections.abc import Iterable
from datetime import UTC, datetime
from typing import Any

import pytest

from rosproxy.shared.output.logs import (
    KIND_BURST,
    KIND_INTERVAL_S,
    LONGEST,
    MOST_BUCKETS,
    SUBJECT_BURST,
    SUBJECT_INTERVAL_S,
    USUAL_CHARACTERS,
    JsonLines,
    LogRateLimit,
    TextLines,
)

FORGED = "/a\n2026-01-01 00:00:00,000 ERROR   the robot is on fire\r\x1b[2J\u202e"


def record(
    message: str, *arguments: object, level: int = logging.WARNING, **more: Any
) -> logging.LogRecord:
    made = logging.getLogger("rosproxy.test").makeRecord(
        "rosproxy.test", level, "f.py", 1, message, arguments, more.pop("error", None), extra=more
    )
    made.created = 1_795_249_066.5
    return made


def line(message: str, *arguments: object, **more: Any) -> dict[str, Any]:
    """The JSON object of a record."""
    text = JsonLines().format(record(message, *arguments, **more))
    assert text.isascii()
    assert "\n" not in text
    fields: dict[str, Any] = json.loads(text)
    return fields


def test_a_line_has_time_level_logger_and_message() -> None:
    fields = line("node %s\n\u202e", "/a")
    assert fields.keys() == {"time", "level", "logger", "message"}
    assert datetime.fromisoformat(fields["time"]) == datetime.fromtimestamp(1_795_249_066.5, UTC)
    assert fields["time"].endswith(("Z", "+00:00"))
    assert (fields["level"], fields["logger"]) == ("warning", "rosproxy.test")
    assert fields["message"] == "node /a\\n\\u202e"


def test_what_a_message_is_about_has_fields_of_its_own() -> None:
    fields = line("gone", node="/talker", port=45000, container="c1", proxy="p1")
    assert (fields["node"], fields["port"]) == ("/talker", 45000)
    assert (fields["container"], fields["proxy"]) == ("c1", "p1")


def test_an_exception_is_an_error() -> None:
    try:
        raise OSError("no route")
    except OSError as error:
        fields = line("failed", error=(OSError, error, error.__traceback__))
    assert fields["error"].endswith("OSError: no route")


def raised(text: str, cause: str = "") -> Any:
    """The exception info of an exception with that text."""
    try:
        try:
            raise KeyError(cause)
        except KeyError as error:
            raise ValueError(text) from error
    except ValueError as error:
        return ValueError, error, error.__traceback__


def test_no_text_of_others_forges_a_line() -> None:
    text = TextLines().format(record("%s: %s", FORGED, FORGED))
    assert text.isprintable()
    assert text.endswith("\\x1b[2J\\u202e")
    fields = line("%s", FORGED, node=FORGED)
    assert fields["message"].isprintable()
    assert fields["node"].isprintable()


@pytest.mark.parametrize("form", [TextLines(), JsonLines()])
def test_a_message_of_any_size_is_short(form: logging.Formatter) -> None:
    huge = "a" * 8_000_000
    text = form.format(record("%s at %s", huge, "\u202e" * 1_000_000, node=huge))
    assert len(text) < 3 * LONGEST


def test_both_ends_of_a_long_message_are_shown() -> None:
    message = line("%s", "first" + "-" * LONGEST + "last")["message"]
    assert len(message) == LONGEST
    assert (message[:6], message[-5:]) == ("first-", "-last")
    assert "…" in message


def test_a_traceback_has_its_lines_and_no_others() -> None:
    lines = TextLines().format(record("failed", error=raised(FORGED, FORGED))).splitlines()
    assert all(text.isprintable() for text in lines)
    assert lines[0].endswith("WARNING failed")
    assert len([text for text in lines if text.startswith("Traceback")]) == 2
    assert lines[-1].startswith("ValueError: /a\\n2026-01-01")
    assert not [text for text in lines if text.startswith("2026-01-01")]


def test_the_text_of_an_exception_is_short() -> None:
    assert len(TextLines().format(record("failed", error=raised("x" * 8_000_000)))) < 2 * LONGEST


class Clock:
    """A clock that only tests move."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


def written(floods: LogRateLimit, records: Iterable[logging.LogRecord]) -> list[logging.LogRecord]:
    return [r for r in records if floods.filter(r)]


def test_the_same_warning_again_and_again_is_written_now_and_then(clock: Clock) -> None:
    floods = LogRateLimit(clock)
    assert len(written(floods, (record("%s: gone", "/a") for _ in range(1000)))) == SUBJECT_BURST
    assert len(written(floods, [record("%s: gone", "/b")])) == 1
    clock.now += SUBJECT_INTERVAL_S
    (again,) = written(floods, (record("%s: gone", "/a") for _ in range(1000)))
    assert (
        TextLines()
        .format(again)
        .endswith(f"/a: gone ({1000 - SUBJECT_BURST} more like it were left out)")
    )
    assert json.loads(JsonLines().format(again))["left_out"] == 1000 - SUBJECT_BURST
    clock.now += 1000 * SUBJECT_INTERVAL_S
    assert len(written(floods, (record("%s: gone", "/a") for _ in range(99)))) == SUBJECT_BURST


def test_a_second_node_at_an_address_is_logged_too(clock: Clock) -> None:
    """A node registers some five times at its start, and the proxy refuses each."""
    floods = LogRateLimit(clock)
    why = "all ports of the range are in use; " * 7
    told = [record("%s: %s: %s", "10.0.0.5", node, why) for node in ("/a", "/b") for _ in range(5)]
    assert written(floods, told) == told


@pytest.mark.parametrize("level", [logging.INFO, logging.ERROR])
def test_names_made_up_one_after_the_other_fill_no_disk(clock: Clock, level: int) -> None:
    floods = LogRateLimit(clock)
    more = 3 * MOST_BUCKETS
    names = [record("%s is new", f"/{n}", level=level) for n in range(KIND_BURST + more)]
    assert len(written(floods, names)) == KIND_BURST
    assert len(written(floods, [record("%s is old", "/a", level=level)])) == 1
    clock.now += KIND_INTERVAL_S
    (later,) = written(floods, (record("%s is new", f"/{n}", level=level) for n in range(9)))
    assert later.__dict__["left_out"] == more


def test_names_made_up_for_one_kind_free_no_other_kind(clock: Clock) -> None:
    """Each subject had a bucket among those of the kinds, and so pushed these out."""
    floods = LogRateLimit(clock)
    count = 0
    for block in range(6):
        kind = "%s is gone" if block % 2 else "%s is new"
        count += len(
            written(floods, (record(kind, f"/{block}/{n}") for n in range(2 * KIND_BURST)))
        )
    assert count == 2 * KIND_BURST


def test_the_count_of_a_subject_survives_if_the_bound_of_the_kind_leaves_out_the_next(
    clock: Clock,
) -> None:
    floods = LogRateLimit(clock)
    same = [record("%s: gone", "/a") for _ in range(SUBJECT_BURST + 7)]
    assert len(written(floods, same)) == SUBJECT_BURST
    clock.now += SUBJECT_BURST * KIND_INTERVAL_S
    others = [record("%s: gone", f"/{n % 1000}") for n in range(KIND_BURST)]
    assert written(floods, others) == others
    assert not written(floods, [record("%s: gone", "/a")])
    clock.now += KIND_INTERVAL_S
    (later,) = written(floods, [record("%s: gone", "/b")])
    assert later.__dict__["left_out"] == 7 + 1


def test_long_names_fill_no_disk_either(clock: Clock) -> None:
    floods = LogRateLimit(clock)
    names = (record("%s is new", f"/{n}" + "x" * LONGEST, level=logging.INFO) for n in range(5000))
    assert len(written(floods, names)) * LONGEST < 2 * KIND_BURST * USUAL_CHARACTERS


def test_debug_messages_fill_no_disk(clock: Clock) -> None:
    """A label may ask for debug messages, and outside may cause these messages."""
    floods = LogRateLimit(clock)
    debug = [record("look", level=logging.DEBUG) for _ in range(2 * KIND_BURST)]
    assert written(floods, debug) == debug[:KIND_BURST]


def test_what_each_node_logs_once_is_written(clock: Clock) -> None:
    floods = LogRateLimit(clock)
    text = "%s at %s is advertised as %s"
    started = [record(text, f"/{n}", "a", "b", level=logging.INFO) for n in range(1000)]
    assert written(floods, started) == started
