"""Showing things on the terminal: the status, once or again and again."""

import json
import shutil
import sys
import time

from rosproxy.cli.admin_client import AdminClient, AdminError
from rosproxy.cli.status_table import render

WATCH_INTERVAL = 2.0
"""Seconds between two drawings; the proxy measures rates as often."""
WIDTH_WITHOUT_TERMINAL = 120
_HOME, _CLEAR_LINE, _CLEAR_BELOW = "\x1b[H", "\x1b[K", "\x1b[J"


def show_status(admin: AdminClient, as_json: bool) -> None:
    """Print the status once. Raises AdminError."""
    status = admin.status()
    columns, _ = size()
    write(json.dumps(status, indent=2) if as_json else render(status, columns))


def watch_status(admin: AdminClient) -> None:
    """Draw the status again and again until interrupted, also while no proxy answers."""
    try:
        while True:
            columns, lines = size()
            try:
                text = render(admin.status(), columns, lines)
            except AdminError as error:
                text = f"{time.strftime('%H:%M:%S')} {error}"
            draw(text)
            time.sleep(WATCH_INTERVAL)
    except KeyboardInterrupt:
        write("")


def write(text: str) -> None:
    """Print a line; what the terminal's encoding lacks is escaped."""
    encoding = sys.stdout.encoding or "utf-8"
    sys.stdout.write(text.encode(encoding, "backslashreplace").decode(encoding) + "\n")
    sys.stdout.flush()


def draw(text: str) -> None:
    """Draw over the last drawing where that is possible, without flicker."""
    if not sys.stdout.isatty():
        write(text + "\n")
        return
    write(_HOME + text.replace("\n", f"{_CLEAR_LINE}\n") + _CLEAR_LINE + _CLEAR_BELOW)


def size() -> tuple[int, int | None]:
    """Columns and lines to use; as many lines as needed where there is no terminal."""
    columns, lines = shutil.get_terminal_size((WIDTH_WITHOUT_TERMINAL, 0))
    return columns, lines - 1 if sys.stdout.isatty() and lines > 5 else None
