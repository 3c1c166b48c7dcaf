"""Logging to standard error, for people as text or for machines as one JSON object per line.

A call says what it is about by ``extra=``: ``node``, ``port``, ``container`` or ``proxy``, where
that is known, for example ``log.info("...", extra={"node": "/talker", "port": 45000})``. JSON lines
have these as fields of their own beside ``time`` (ISO 8601, UTC), ``level``, ``logger``,
``message`` and, with a traceback, ``error``; text lines have the message alone.
"""

import logging
from typing import Any

from pythonjsonlogger.json import JsonFormatter

_NAMES = {"levelname": "level", "name": "logger", "exc_info": "error"}


class JsonLines(JsonFormatter):
    """Formats a record as JSON, with the fields above."""

    def __init__(self) -> None:
        super().__init__(["levelname", "name", "message"], rename_fields=_NAMES, timestamp="time")

    def process_log_record(self, log_data: dict[str, Any]) -> dict[str, Any]:
        """The fields, with the level in lower case."""
        return {**log_data, "level": log_data["level"].lower()}


def set_up(form: str, level: str) -> None:
    """Log to standard error in ``form`` (text or json) from ``level`` on."""
    handler = logging.StreamHandler()
    if form == "json":
        handler.setFormatter(JsonLines())
    else:
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)-7s %(message)s"))
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)
    # Strangers that speak no HTTP are not errors of ours.
    logging.getLogger("aiohttp.server").setLevel(logging.CRITICAL)
