"""Text for logs and terminals: harmless, and measured in terminal columns.

Pure functions from values to text and lines. `rosproxy.shared.output.tables` makes tables, and
`rosproxy.cli.terminal` prints lines. Nodes choose the names of nodes and topics. So call `clean`
before all other functions here; only `brief` and `quoted` call `clean` themselves.
"""

import shlex
import textwrap
from collections.abc import Iterable
from itertools import pairwise

from rich.cells import cell_len

LONGEST_QUOTED = 120
"""Characters of a quoted name in a fix. A fix with five such names is shorter than the bound of
`brief`, which could otherwise cut a closing quote."""
_TIMES = ((86400.0, "d"), (3600.0, "h"), (60.0, "min"), (1.0, "s"))
_UNITS = ("B", "kB", "MB", "GB", "TB")


def clean(text: object) -> str:
    """The text with escapes for all characters that are not printable.

    Such characters could move the cursor, or hide or reorder text.
    """
    shown = str(text)
    if shown.isprintable():
        return shown
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in shown)


def brief(text: object, most: int) -> str:
    """A clean text of at most ``most`` characters; in a longer text, ``…`` replaces the middle.

    For texts that are kept, sent or logged. `shorten` bounds terminal columns instead.
    """
    shown = str(text)
    if len(shown) > most:  # before `clean`, which takes time and may make ten characters of one
        shown = _without_middle(shown, most)
    shown = clean(shown)
    return shown if len(shown) <= most else _without_middle(shown, most)


def quoted(name: str) -> str:
    """A clean name as a single word of a shell, for commands that users paste.

    Names of real nodes and topics stay unquoted. The result is NAME for a name that is too long.
    """
    word = shlex.quote(clean(name))
    return word if len(word) <= LONGEST_QUOTED else "NAME"


def width(text: str) -> int:
    """The terminal columns of a clean text: 2 for East Asian characters, 0 for combining marks."""
    return cell_len(text)


def shorten(text: str, most: int) -> str:
    """The text in at most ``most`` columns; a wider text loses its middle.

    The ends stay, because names differ at the ends.
    """
    if width(text) <= most:
        return text
    room = max(most - 1, 0)
    tail = _head(text[::-1], room // 2)[::-1]
    return f"{_head(text, room - width(tail))}…{tail}"


def wrap(
    text: str, columns: int, indent: str, first: str = "", most: int | None = None
) -> list[str]:
    """Lines of at most ``columns``, each with ``indent``; the first line with ``first`` if given.

    There are at most ``most`` lines; a shortened text ends in an ellipsis. A line always has room
    for 20 columns after the indent. Words stay whole, even if longer than a line: users may copy
    commands.
    """
    return textwrap.wrap(
        text,
        max(columns, width(indent) + 20),
        initial_indent=first or indent,
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
        max_lines=most,
        placeholder=" …",
    )


def duration(seconds: float) -> str:
    """A time in one or two units: ``0.4 s``, ``12 s``, ``3 min``, ``2 h 5 min``, ``1 d 3 h``."""
    if seconds < 10:
        return f"{max(seconds, 0.0):.1f} s"
    size, unit = next(row for row in _TIMES if seconds >= row[0])
    count, rest = divmod(seconds, size)
    below = dict(pairwise(_TIMES)).get((size, unit))
    minor = int(rest // below[0]) if below and unit != "min" else 0
    return f"{count:.0f} {unit}" + (f" {minor} {below[1]}" if below and minor else "")


def size(count: float) -> str:
    """A number of bytes: ``812 B``, ``1.5 kB``."""
    unit = 0
    while count >= 999.5 and unit < len(_UNITS) - 1:
        count = count / 1000
        unit = unit + 1
    digits = 1 if unit and count < 99.95 else 0
    return f"{count:.{digits}f} {_UNITS[unit]}"


def plural(count: int, noun: str) -> str:
    """``1 port``, ``2 ports``, ``2 addresses``, ``2 proxies``, ``2 keys``."""
    if count == 1:
        return f"{count} {noun}"
    if noun.endswith("y") and noun[-2] not in "aeo":
        return f"{count} {noun[:-1]}ies"
    return f"{count} {noun}es" if noun.endswith("s") else f"{count} {noun}s"


def listed(items: Iterable[str], most: int = 5) -> str:
    """The first ``most`` items, and the number of further items."""
    texts = list(items)
    left_out = len(texts) - most
    return ", ".join(texts[:most]) + (f" and {left_out} more" if left_out > 0 else "")


def _head(text: str, room: int) -> str:
    """The beginning of a text that fits into ``room`` columns."""
    end = 0
    for end, character in enumerate(text):
        room -= width(character)
        if room < 0:
            return text[:end]
    return text


def _without_middle(text: str, most: int) -> str:
    """The two ends of a text, with a mark in between, in ``most`` characters."""
    tail = max(most - 1, 0) // 2
    return f"{text[: most - 1 - tail]}…{text[len(text) - tail :]}"
