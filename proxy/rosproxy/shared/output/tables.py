"""Tables for a terminal, as lines of text.

rich makes the layout. Each cell is a ``Text``, in which rich reads no markup. The import of rich
takes a tenth of a second, and only commands of users show tables. So this is a separate module,
which the proxy does not import at the start.
"""

import io
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from rosproxy.shared.output.text import shorten, width

GAP = "  "
_CONSOLE = Console(file=io.StringIO(), color_system=None, width=80, height=25, legacy_windows=False)
"""A console that makes layouts, and prints nothing."""


def table(rows: Sequence[Sequence[str]], left: int, room: int) -> list[str]:
    """The lines of a table. The first row is the heading; there must be at least one row.

    The first ``left`` columns are aligned left, the rest right. The first cell of each row gets
    ``room`` terminal columns at most; a wider cell is shortened.
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
    """The terminal columns that a table needs besides its first column."""
    return sum(len(GAP) + max(map(width, cells)) for cells in [*zip(*rows, strict=True)][1:])
