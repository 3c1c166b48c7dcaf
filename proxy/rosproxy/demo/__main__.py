"""`python -m rosproxy.demo`: run the demo and judge it."""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import sys
from dataclasses import asdict
from typing import Any

import click

from rosproxy.demo.board import Board
from rosproxy.demo.course import Course
from rosproxy.demo.layout import Layout, detect
from rosproxy.demo.processes import DemoError, Processes
from rosproxy.demo.screen import choose, keep_drawing, summary
from rosproxy.demo.tally import Verdict, judge

SHORTEST = 4
INTERRUPTED = 130


class Outcome:
    """What a run of the demo came to."""

    def __init__(self, seconds: float, verdicts: list[Verdict], evidence: dict[str, Any]) -> None:
        self.seconds = seconds
        self.verdicts = verdicts
        self.evidence = evidence
        self.log: list[str] = []

    @property
    def ok(self) -> bool:
        """Whether every expectation was met."""
        return all(verdict.met for verdict in self.verdicts)

    def to_json(self) -> str:
        """Return the outcome as a JSON document."""
        fields = {
            "ok": self.ok,
            "seconds": round(self.seconds, 3),
            "expectations": [asdict(verdict) for verdict in self.verdicts],
            "evidence": self.evidence,
            "log": self.log,
        }
        return json.dumps(fields, indent=2)


async def perform(seconds: float, layout: Layout, *, quiet: bool) -> Outcome:
    """Run the demo; whatever happens, no process is left when this returns."""
    board, screen = Board(), choose(quiet=quiet)
    drawing = asyncio.create_task(keep_drawing(screen, board))
    try:
        outcome = await _run(seconds, layout, board)
    finally:
        drawing.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await drawing
    screen.draw(board)
    return outcome


async def _run(seconds: float, layout: Layout, board: Board) -> Outcome:
    problem, log = "", []
    async with Processes() as processes:
        course = Course(layout, processes, board, seconds)
        try:
            await course.run()
        except DemoError as error:
            problem = str(error)
            board.tell(f"stopped: {problem}")
    log = processes.last_words()
    verdicts = judge(course.evidence)
    if problem:
        verdicts.insert(0, Verdict("the demo runs to its end", met=False, detail=problem))
    outcome = Outcome(board.clock(), verdicts, course.evidence.to_json())
    outcome.log = [] if outcome.ok else log
    return outcome


async def _interruptible(seconds: float, *, quiet: bool) -> Outcome | None:
    """Run the demo so that the first signal ends it in good order, and further ones don't hurt."""
    work = asyncio.create_task(perform(seconds, detect(), quiet=quiet))
    loop = asyncio.get_running_loop()
    stopping = asyncio.Event()

    def stop() -> None:
        if not stopping.is_set():
            stopping.set()
            work.cancel()

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        loop.add_signal_handler(number, stop)
    try:
        return await work
    except asyncio.CancelledError:
        return None


@click.command(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.option(
    "--seconds",
    type=click.FloatRange(min=SHORTEST, max=3600),
    default=15,
    show_default=True,
    help="How long the demo takes, about.",
)
@click.option(
    "--json", "as_json", is_flag=True, help="Show nothing live; print the summary as JSON."
)
def main(seconds: float, as_json: bool) -> None:
    """Show rosproxy at work: nodes on both sides of a boundary, with the real proxy between them.

    A small ROS master and small nodes are built in; nothing else is needed. In the middle the
    proxy is killed and restarted. Exits with 0 only if every message count fits.
    """
    outcome = asyncio.run(_interruptible(seconds, quiet=as_json))
    if outcome is None:
        click.echo("interrupted; all processes ended", err=True)
        sys.exit(INTERRUPTED)
    if as_json:
        click.echo(outcome.to_json())
    else:
        click.echo(summary(outcome.verdicts, color=sys.stdout.isatty()))
        for line in outcome.log:
            click.echo(line, err=True)
    sys.exit(0 if outcome.ok else 1)


if __name__ == "__main__":
    main()
