"""What kopf and the client log, as far as anybody wants to read it."""

import logging
import re

from rosproxy_operator.kubernetes.errors import missing_rule

log = logging.getLogger(__name__)

_FORBIDDEN = re.compile(r"APIForbiddenError\(\W?(?P<text>.*)")
_LOUD = ("kubernetes", "urllib3")


class KopfLog(logging.Handler):
    """Tells once which rule is missing for watching, and everything else only at debug level.

    kopf logs each try at an API server that is away, for every kind of object; the operator's own
    looks say so once, in one line. But for the rule that only watching needs nobody else asks.
    """

    def __init__(self) -> None:
        super().__init__()
        self._told: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        """Tell what a record says, if it is worth it."""
        text = record.getMessage()
        found = _FORBIDDEN.search(text)
        rule = missing_rule(found["text"]) if found else ""
        if rule and rule not in self._told:
            self._told.add(rule)
            log.warning("watching is refused, so changes are seen late: %s", rule)
        log.debug("kopf: %s", text)


def quieten() -> None:
    """Take kopf's loggers over, and keep the libraries below from telling of each request."""
    kopf = logging.getLogger("kopf")
    kopf.handlers, kopf.propagate = [KopfLog()], False
    debug = logging.getLogger().isEnabledFor(logging.DEBUG)
    kopf.setLevel(logging.DEBUG if debug else logging.ERROR)
    for name in _LOUD:
        logging.getLogger(name).setLevel(logging.INFO if debug else logging.CRITICAL)
    logging.getLogger("asyncio").setLevel(logging.INFO)
    logging.getLogger("aiohttp.access").setLevel(logging.WARNING)
