"""Logs as JSON, one object per line, with fields for what a message is about."""

import json
import logging
from datetime import UTC, datetime
from typing import Any

from rosproxy.telemetry.logs import JsonLines


def line(message: str, *arguments: object, **more: Any) -> dict[str, Any]:
    """A record as the object of its line."""
    record = logging.getLogger("rosproxy.test").makeRecord(
        "rosproxy.test", logging.WARNING, "f.py", 1, message, arguments, more.pop("error", None),
        extra=more,
    )  # fmt: skip
    record.created = 1_795_249_066.5
    text = JsonLines().format(record)
    assert text.isascii()
    assert "\n" not in text
    found: dict[str, Any] = json.loads(text)
    return found


def test_a_line_has_time_level_logger_and_message() -> None:
    found = line("node %s\n\u202e", "/a")
    assert found.keys() == {"time", "level", "logger", "message"}
    assert datetime.fromisoformat(found["time"]) == datetime.fromtimestamp(1_795_249_066.5, UTC)
    assert found["time"].endswith(("Z", "+00:00"))
    assert (found["level"], found["logger"]) == ("warning", "rosproxy.test")
    assert found["message"] == "node /a\n\u202e"


def test_what_a_message_is_about_has_fields_of_its_own() -> None:
    found = line("gone", node="/talker", port=45000, container="c1", proxy="p1")
    assert (found["node"], found["port"]) == ("/talker", 45000)
    assert (found["container"], found["proxy"]) == ("c1", "p1")


def test_an_exception_is_an_error() -> None:
    try:
        raise OSError("no route")
    except OSError as error:
        found = line("failed", error=(OSError, error, error.__traceback__))
    assert found["error"].endswith("OSError: no route")
