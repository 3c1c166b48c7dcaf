"""Text for logs and a terminal: harmless whatever it holds, and as wide as it looks.

Pure functions from values to text and to lines; `rosproxy.telemetry.tables` makes tables of them
and `rosproxy.cli.terminal` prints them. Names of nodes and topics are whatever a node says they
are, so that `clean` comes before everything else.
"""

import shlex
import textwrap
from collections.abc import Iterable
from itertools import pairwise

from rich.cells import cell_len

LONGEST_QUOTED = 120
"""Characters of a name in a fix. Five of them fit where a fix is shortened (`brief`), which would
otherwise take a closing quote."""
_TIMES = ((86400.0, "d"), (3600.0, "h"), (60.0, "min"), (1.0, "s"))
_UNITS = ("B", "kB", "MB", "GB", "TB")


def clean(text: object) -> str:
    """A text with everything escaped that could move the cursor, hide or reorder other text.

    Node and topic names are whatever a node says they are.
    """
    shown = str(text)
    if shown.isprintable():
        return shown
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in shown)


def brief(text: object, most: int) -> str:
    """A clean text of at most ``most`` characters; a longer one without its middle, and marked.

    For what is kept, sent or logged: how wide it looks does not matter there.
    """
    shown = str(text)
    if len(shown) > most:  # first, since cleaning takes time and may make ten characters of one
        shown = _without_middle(shown, most)
    shown = clean(shown)
    return shown if len(shown) <= most else _without_middle(shown, most)


def quoted(name: str) -> str:
    """A name as one word of a shell: an engineer pastes commands that nodes have chosen names in.

    Names of real nodes and topics stay as they are. NAME stands for one that is too long.
    """
    word = shlex.quote(clean(name))
    return word if len(word) <= LONGEST_QUOTED else "NAME"


def width(text: str) -> int:
    """How many columns a clean text takes: East Asian characters two, combining marks none."""
    return cell_len(text)


def shorten(text: str, most: int) -> str:
    """The text in ``most`` columns: without its middle, since both ends tell names apart."""
    if width(text) <= most:
        return text
    room = max(most - 1, 0)
    tail = _head(text[::-1], room // 2)[::-1]
    return f"{_head(text, room - width(tail))}…{tail}"


def wrap(
    text: str, columns: int, indent: str, first: str = "", most: int | None = None
) -> list[str]:
    """Lines of at most ``columns``, led by ``indent``; the first one by ``first`` if given.

    Not more than ``most`` lines, the last of which then ends in an ellipsis. Words stay whole,
    even those that are too long for a line: they may be commands to copy.
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
    """A time in its two largest units: ``0.4 s``, ``12 s``, ``3 min``, ``2 h 5 min``."""
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
    """``1 port``, ``2 ports``, ``2 addresses``."""
    if count == 1:
        return f"{count} {noun}"
    return f"{count} {noun}es" if noun.endswith("s") else f"{count} {noun}s"


def listed(items: Iterable[str], most: int = 5) -> str:
    """The first few items, and how many more there are."""
    texts = list(items)
    left_out = len(texts) - most
    return ", ".join(texts[:most]) + (f" and {left_out} more" if left_out > 0 else "")


def _head(text: str, room: int) -> str:
    """As much of a text as fits."""
    end = 0
    for end, character in enumerate(text):
        room -= width(character)
        if room < 0:
            return text[:end]
    return text


def _without_middle(text: str, most: int) -> str:
    """The two ends of a text, with a mark between them."""
    tail = max(most - 1, 0) // 2
    return f"{text[: most - 1 - tail]}…{text[len(text) - tail :]}"
