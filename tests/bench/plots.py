"""Plots of what was measured at several sizes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tests.bench.book import DIRECT, Book, Line
from tests.bench.report import grows, paths_of

COLUMNS = 2
SPREADING = 20
"""If the largest value of a row is this multiple of the smallest, the scale is logarithmic."""


def draw(book: Book, section: str, file: Path) -> bool:
    """Draw a section, with a plot for each growing row. False without such a row."""
    rows: dict[str, list[Line]] = {}
    for line in book.lines():
        if line.section == section:
            rows.setdefault(line.row, []).append(line)
    growing = {row: lines for row, lines in rows.items() if grows(lines)}
    if growing:
        _draw(growing, book.axes[section], file)
    return bool(growing)


def _draw(rows: dict[str, list[Line]], axis: str, file: Path) -> None:
    import matplotlib as mpl

    mpl.use("svg")
    mpl.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "rosproxy", "font.size": 9})
    from matplotlib import pyplot

    height = -(-len(rows) // COLUMNS)
    figure, grid = pyplot.subplots(height, COLUMNS, figsize=(10, 3.4 * height), squeeze=False)
    places = list(grid.flat)
    everybody = paths_of(
        sorted((line for lines in rows.values() for line in lines), key=_is_not_direct)
    )
    for place, (row, lines) in zip(places, rows.items(), strict=False):
        _plot(place, row, lines, axis, everybody)
    for empty in places[len(rows) :]:
        empty.set_axis_off()
    figure.tight_layout()
    figure.savefig(file, metadata={"Date": None})
    pyplot.close(figure)


def _is_not_direct(line: Line) -> bool:
    return line.path != DIRECT


def _plot(place: Any, row: str, lines: list[Line], axis: str, everybody: list[str]) -> None:
    """Draw the medians as a coloured line for each path, with bars from lowest to highest."""
    for path in paths_of(lines):
        mine = sorted((line for line in lines if line.path == path), key=lambda line: line.size)
        middles = [line.middle for line in mine]
        below = [line.middle - min(line.values) for line in mine]
        above = [max(line.values) - line.middle for line in mine]
        sizes = [line.size for line in mine]
        looks = {"color": f"C{everybody.index(path) % 10}", "marker": ".", "capsize": 2, "lw": 1.2}
        place.errorbar(sizes, middles, (below, above), label=path, **looks)
    values = [line.middle for line in lines]
    sizes = sorted({line.size for line in lines})
    place.set_xscale("log")
    place.set_xticks(sizes, [f"{size:,}" for size in sizes])
    place.minorticks_off()
    if min(values) > 0 and max(values) / min(values) > SPREADING:
        place.set_yscale("log")
    else:
        place.set_ylim(bottom=0)
    place.set(title=row, xlabel=axis)
    place.grid(alpha=0.3)
    place.legend(fontsize=7)
