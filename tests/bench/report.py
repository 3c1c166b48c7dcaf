"""The results for readers: a table, Markdown, and plots of growing rows.

    python -m tests.bench.report [--folder build/bench] [--page docs/performance.md [--part ros2]]

writes the results from ``results.json``. With a page, the command replaces the text between two
marks, and puts the plots beside the page, so that no number is typed by hand. A separately measured
part of a page has different marks.
"""

from __future__ import annotations

import argparse
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

from tests.bench.book import Book, Line

BEGIN = "<!-- results: written by a program -->"
END = "<!-- end of results -->"
MISSING = "-"
TITLES = {
    "streams": "Bytes, from a node inside to subscribers outside",
    "control": "Calls of the master and slave API",
    "nodes": "Many nodes",
    "ros": "Real ROS nodes",
    "ros2": "ROS 2",
    "rmw_zenoh": "rmw_zenoh",
    "page": "The live page",
    "cluster": "The operator in a growing cluster",
    "docker": "The operator on a Docker host",
}


def write(book: Book, folder: Path) -> None:
    """``performance.md`` and an SVG for each section with something that grows."""
    (folder / "performance.md").write_text(markdown(book, drawn(book, folder)))


def drawn(book: Book, folder: Path) -> list[str]:
    """The sections that have a plot now."""
    from tests.bench import plots

    return [name for name in book.axes if plots.draw(book, name, folder / f"{name}.svg")]


def print_table(book: Book, section: str) -> None:
    """A section as text: median, lowest and highest of the rounds, and the ratio to direct."""
    lines = [line for line in book.lines() if line.section == section]
    rounds = max((len(line.values) for line in lines), default=0)
    wide = [max((len(text) for text in texts), default=0) for texts in _names(lines)]
    head = f"{section}, {rounds} rounds".ljust(sum(wide) + 2)
    print(f"\n{head}{book.axes[section]:>12}{'median':>10}{'lowest .. highest':>22}  to direct")
    for line in lines:
        low, middle, high = map(number, (min(line.values), line.middle, max(line.values)))
        ratio = f"{line.to_direct:9.2f} x" if line.to_direct is not None else ""
        name = f"{line.row:<{wide[0]}}  {line.path:<{wide[1]}}"
        print(f"{name}{line.size:>12}{middle:>10}{low:>10} .. {high:<8}{ratio}".rstrip())
    print(*(note for note in book.notes if note.startswith(f"{section}:")), sep="\n", flush=True)


def _names(lines: list[Line]) -> tuple[list[str], list[str]]:
    return [line.row for line in lines], [line.path for line in lines]


def number(value: float) -> str:
    """Three digits that count, and never an exponent."""
    if value == 0:
        return "0"
    if abs(value) >= 999.5:
        return f"{value:,.0f}"
    return f"{value:.3g}" if abs(value) >= 0.001 else "< 0.001"


def markdown(book: Book, plots: list[str]) -> str:
    """All sections; the links lead to plots beside the page."""
    machine = "\n".join(f"| {name} | {text} |" for name, text in book.machine.items())
    parts = [f"| Measured | |\n|---|---|\n{machine}"]
    for section in book.axes:
        parts += [f"### {TITLES.get(section, section)}", *tables(book, section)]
        if section in plots:
            alt = f"A plot for each measure: median and spread against {book.axes[section]}"
            parts.append(f"![{alt}]({section}.svg)")
        parts += [note.partition(": ")[2] + "." for note in notes_of(book, section)]
    return "\n\n".join(parts) + "\n"


def notes_of(book: Book, section: str) -> list[str]:
    return [note.rstrip(".") for note in book.notes if note.startswith(f"{section}:")]


def tables(book: Book, section: str) -> Iterator[str]:
    """A table for each row with several sizes, and tables for all other rows."""
    rows: dict[str, list[Line]] = {}
    for line in book.lines():
        if line.section == section:
            rows.setdefault(line.row, []).append(line)
    single = {row: lines for row, lines in rows.items() if not grows(lines)}
    for row, lines in rows.items():
        if row not in single:
            yield by_size(row, lines, book.axes[section])
    for head in dict.fromkeys(split(row)[1] for row in single):
        yield by_path(
            head, {split(row)[0]: lines for row, lines in single.items() if split(row)[1] == head}
        )


def split(row: str) -> tuple[str, str]:
    """Subject and measure of a row. The measure is the heading of a table."""
    subject, _, measure = row.partition(": ")
    return subject, measure


def grows(lines: list[Line]) -> bool:
    return len({line.size for line in lines}) > 1


def by_size(row: str, lines: list[Line], axis: str) -> str:
    """Paths down, sizes across."""
    sizes = sorted({line.size for line in lines})
    cells = {(line.path, line.size): cell(line) for line in lines}
    head = [f"{row}; {axis}:", *map(str, sizes)]
    body = [
        [path, *(cells.get((path, size), MISSING) for size in sizes)] for path in paths_of(lines)
    ]
    return table(head, body)


def by_path(head: str, rows: dict[str, list[Line]]) -> str:
    """Rows down, paths across."""
    paths = paths_of([line for lines in rows.values() for line in lines])
    body = []
    for row, lines in rows.items():
        cells = {line.path: cell(line) for line in lines}
        body.append([row, *(cells.get(path, MISSING) for path in paths)])
    return table([head, *paths], body)


def paths_of(lines: list[Line]) -> list[str]:
    return list(dict.fromkeys(line.path for line in lines))


def cell(line: Line) -> str:
    """The median with the ratio to direct, and the spread of several rounds."""
    ratio = f" **x {line.to_direct:.2f}**" if line.to_direct is not None else ""
    spread = f" ({number(min(line.values))} .. {number(max(line.values))})"
    return number(line.middle) + ratio + (spread if len(line.values) > 1 else "")


def table(head: list[str], body: list[list[str]]) -> str:
    lines = [head, ["---"] + ["---:"] * (len(head) - 1), *body]
    return "\n".join("| " + " | ".join(words) + " |" for words in lines)


def paste(page: Path, folder: Path, section: str = "") -> None:
    """Write the results into a page, between the marks of a part. Raises SystemExit without
    marks.
    """
    text = page.read_text()
    begin, end = (
        mark.replace("results", f"results of {section}" if section else "results")
        for mark in (BEGIN, END)
    )
    pattern = re.compile(f"{re.escape(begin)}.*?{re.escape(end)}", re.S)
    if not pattern.search(text):
        raise SystemExit(f"{page} has no {begin} … {end}")
    results = (folder / "performance.md").read_text()
    plots = page.with_suffix("")
    plots.mkdir(exist_ok=True)
    for plot in folder.glob("*.svg"):
        shutil.copy(plot, plots)
    results = re.sub(r"(!\[[^]]*\]\()", rf"\1{plots.name}/", results)
    page.write_text(pattern.sub(lambda _: f"{begin}\n\n{results}\n{end}", text))


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.report")
    parser.add_argument("--folder", type=Path, default=Path("build/bench"))
    parser.add_argument("--page", type=Path)
    parser.add_argument("--part", default="")
    options = parser.parse_args()
    book = Book.load(options.folder / "results.json")
    for section in book.axes:
        print_table(book, section)
    write(book, options.folder)
    if options.page:
        paste(options.page, options.folder, options.part)


if __name__ == "__main__":
    main()
