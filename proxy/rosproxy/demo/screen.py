"""The demo on the terminal: a table that redraws itself, or plain lines where there is none."""

from __future__ import annotations

import asyncio
import shutil
import sys
from dataclasses import astuple
from typing import TextIO

from rosproxy.demo.board import HEADINGS, Board, Row
from rosproxy.demo.tally import Verdict

BOLD, DIM, GREEN, RED, PLAIN = "\x1b[1m", "\x1b[2m", "\x1b[32m", "\x1b[31m", "\x1b[0m"
CLEAR_LINE, CLEAR_BELOW = "\x1b[K", "\x1b[J"
EVENTS_SHOWN = 8
# The counts stand to the right, everything else to the left.
RIGHT = (False, False, False, False, True, True, True, False)


def _widths(rows: list[Row]) -> list[int]:
    columns = zip(*(astuple(row) for row in rows), strict=True)
    return [max(len(cell) for cell in column) for column in columns]


def _line(row: Row, widths: list[int], gap: str) -> str:
    cells = zip(astuple(row), widths, RIGHT, strict=True)
    return gap.join(
        cell.rjust(width) if right else cell.ljust(width) for cell, width, right in cells
    ).rstrip()


def table(rows: list[Row], width: int) -> list[str]:
    """Return the table's lines, headings first; closer together where `width` is short."""
    everything = [HEADINGS, *rows]
    widths = _widths(everything)
    gap = "  " if sum(widths) + 2 * len(widths) <= width else " "
    return [_line(row, widths, gap) for row in everything]


def event_lines(board: Board) -> list[str]:
    """Return all that happened, each with its time."""
    return [f"{moment:5.1f} s  {text}" for moment, text in board.events]


def frame(board: Board, width: int) -> list[tuple[str, str]]:
    """Return the whole screen as pairs (style, line)."""
    title = f"{board.clock():5.1f} s  [rosproxy {board.proxy}]  {board.phase}"
    headings, *rows = table(board.rows(), width)
    events = event_lines(board)[-EVENTS_SHOWN:]
    return [
        (BOLD, title),
        ("", ""),
        (DIM, headings),
        *(("", row) for row in rows),
        ("", ""),
        *(("", event) for event in events),
    ]


class LiveScreen:
    """Redraws the frame in place a few times a second."""

    interval = 0.2

    def __init__(self, out: TextIO) -> None:
        self._out = out
        self._height = 0

    def draw(self, board: Board) -> None:
        """Draw over the frame that was drawn last."""
        width = shutil.get_terminal_size().columns
        shown = frame(board, width)
        lines = [f"{style}{text[: width - 1]}{PLAIN}{CLEAR_LINE}" for style, text in shown]
        up = f"\x1b[{self._height}A" if self._height else ""
        self._out.write(up + "\n".join(lines) + "\n" + CLEAR_BELOW)
        self._out.flush()
        self._height = len(lines)


class LineScreen:
    """Prints each event once, and a line of counts every second."""

    interval = 1.0

    def __init__(self, out: TextIO) -> None:
        self._out = out
        self._told = 0

    def draw(self, board: Board) -> None:
        """Print what is new."""
        lines = event_lines(board)[self._told :]
        self._told += len(lines)
        lines.append(f"{board.clock():5.1f} s  [{board.phase}] {_counts(board)}")
        self._out.write("\n".join(lines) + "\n")
        self._out.flush()


def _counts(board: Board) -> str:
    rows = [row for row in board.rows() if row.sent or row.received]
    return "  ".join(
        f"{row.side} {row.node}: {row.sent or row.received} ({row.state})" for row in rows
    )


class NoScreen:
    """Shows nothing: for `--json`."""

    interval = 1.0

    def draw(self, board: Board) -> None:
        """Draw nothing."""


Screen = LiveScreen | LineScreen | NoScreen


async def keep_drawing(screen: Screen, board: Board) -> None:
    """Draw until cancelled."""
    while True:
        screen.draw(board)
        await asyncio.sleep(screen.interval)


def choose(*, quiet: bool) -> Screen:
    """Choose the screen that fits standard output."""
    if quiet:
        return NoScreen()
    return LiveScreen(sys.stdout) if sys.stdout.isatty() else LineScreen(sys.stdout)


def summary(verdicts: list[Verdict], *, color: bool) -> str:
    """Return the closing list of expectations."""
    lines = [""]
    for verdict in verdicts:
        word, style = ("ok", GREEN) if verdict.met else ("FAILED", RED)
        mark = f"{style}{word:<6}{PLAIN}" if color else f"{word:<6}"
        lines.append(f"{mark}  {verdict.expectation}: {verdict.detail}")
    met = sum(verdict.met for verdict in verdicts)
    return "\n".join([*lines, "", f"{met} of {len(verdicts)} expectations met"])
