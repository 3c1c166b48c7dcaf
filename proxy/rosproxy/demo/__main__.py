"""`python -m rosproxy.demo`: play the demonstration and say whether it worked."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from dataclasses import asdict

import click
from rich.console import Console

from rosproxy.demo.scenario import Scenario
from rosproxy.demo.screen import print_summary, show

SHORTEST = 4
INTERRUPTED = 130


async def perform(seconds: float, console: Console) -> Scenario | None:
    """Play to the end, or to the first signal: None; no process is left in either case."""
    scenario = Scenario(seconds)
    playing = asyncio.create_task(scenario.play())
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        loop.add_signal_handler(number, lambda: playing.cancelling() or playing.cancel())
    showing = asyncio.create_task(show(scenario, console))
    try:
        await playing
    except asyncio.CancelledError:
        return None
    finally:
        showing.cancel()
        await showing
    return scenario


def as_json(scenario: Scenario) -> str:
    """The outcome as a JSON document."""
    fields = {
        "ok": scenario.ok,
        "seconds": round(scenario.clock(), 3),
        "checks": [asdict(check) for check in scenario.checks],
        "log": [] if scenario.ok else [*scenario.proxy.log],
    }
    return json.dumps(fields, indent=2)


@click.command(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.option(
    "--seconds",
    type=click.FloatRange(min=SHORTEST, max=3600),
    default=15,
    show_default=True,
    help="How long the demo takes, about.",
)
@click.option("--json", "quiet", is_flag=True, help="Show nothing live; print the summary as JSON.")
def main(seconds: float, quiet: bool) -> None:
    """Show rosproxy at work: nodes on both sides of a boundary, with the real proxy between them.

    A small ROS master and small nodes are built in; nothing else is needed. In the middle the
    proxy is killed and restarted. Exits with 0 only if all worked and every message count fits.
    """
    # The inside names resolve nowhere; a resolver that is slow to say so must not slow us down.
    os.environ["RES_OPTIONS"] = "timeout:1 attempts:1"
    console = Console(quiet=quiet)
    scenario = asyncio.run(perform(seconds, console))
    if scenario is None:
        click.echo("interrupted; all processes ended", err=True)
        sys.exit(INTERRUPTED)
    if quiet:
        click.echo(as_json(scenario))
    else:
        print_summary(scenario, console)
        for line in () if scenario.ok else scenario.proxy.log:
            click.echo(f"rosproxy: {line}", err=True)
    sys.exit(0 if scenario.ok else 1)


if __name__ == "__main__":
    main()
