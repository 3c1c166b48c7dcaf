"""Tables for a terminal, as lines of text.

Laid out by rich, which is given each cell as ``Text``, in which nothing is markup. It takes a tenth
of a second to import, and only what a user calls shows tables: a module of its own keeps it out of
the proxy's start.
"""

import io
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from rosproxy.telemetry.text import shorten, width

GAP = "  "
_CONSOLE = Console(file=io.StringIO(), color_system=None, width=80, height=25, legacy_windows=False)
"""Lays out and prints nothing."""


def table(rows: Sequence[Sequence[str]], left: int, room: int) -> list[str]:
    """Lines of a table with its heading in the first row.

    The first ``left`` cells stand left, the others right. The first cell gets ``room`` columns at
    most and is shortened where it has more.
    """
    grid = Table.grid(padding=(0, len(GAP), 0, 0))
    for index in range(len(rows[0])):
        grid.add_column(justify="left" if index < left else "right", no_wrap=True)
    for name, *cells in rows:
        grid.add_row(Text(shorten(name, room)), *map(Text, cells))
    options = _CONSOLE.options.update_width(room + besides_first(rows))
    lines = _CONSOLE.render_lines(grid, options)
    return ["".join(segment.text for segment in line).rstrip() for line in lines]


def besides_first(rows: Sequence[Sequence[str]]) -> int:
    """The columns that a table takes besides its first cells."""
    return sum(len(GAP) + max(map(width, cells)) for cells in [*zip(*rows, strict=True)][1:])
