"""`python -m examples.demo`: play the demonstration and print the results."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from dataclasses import asdict

import click
from rich.console import Console

from examples.demo.scenario import Scenario
from examples.demo.screen import print_summary, show

INTERRUPTED = 130


async def perform(scenario: Scenario, console: Console) -> bool:
    """Play to the end. False if a signal came first. No process is left in either case."""
    playing = asyncio.create_task(scenario.play())
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        loop.add_signal_handler(number, lambda: playing.cancelling() or playing.cancel())
    showing = asyncio.create_task(show(scenario, console))
    try:
        await playing
    except asyncio.CancelledError:
        return False
    finally:
        showing.cancel()
        await showing
    return True


@click.command(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.option(
    "--seconds",
    type=click.FloatRange(min=4, max=3600),
    default=15,
    show_default=True,
    help="How long the demo takes, about.",
)
@click.option("--json", "quiet", is_flag=True, help="Show nothing live; print the summary as JSON.")
def main(seconds: float, quiet: bool) -> None:
    """Show rosproxy at work: nodes on both sides of a boundary, with the real proxy between them.

    A small ROS master and small nodes of ROS 1 and ROS 2 are built in; nothing else is needed. In
    the middle the proxy is killed and restarted. Exits with 0 only if all worked and every message
    count fits.
    """
    # The inside names do not resolve. A slow resolver must not delay the demonstration.
    os.environ["RES_OPTIONS"] = "timeout:1 attempts:1"
    console = Console(quiet=quiet)
    scenario = Scenario(seconds)
    if not asyncio.run(perform(scenario, console)):
        click.echo("interrupted; all processes ended", err=True)
        sys.exit(INTERRUPTED)
    log = [] if scenario.ok else [*scenario.proxy.log]
    if quiet:
        checks = [asdict(check) for check in scenario.checks]
        took = round(scenario.clock(), 3)
        outcome = {"ok": scenario.ok, "seconds": took, "checks": checks, "log": log}
        click.echo(json.dumps(outcome, indent=2))
    else:
        print_summary(scenario, console)
        for line in log:
            click.echo(f"rosproxy: {line}", err=True)
    sys.exit(0 if scenario.ok else 1)


if __name__ == "__main__":
    main()
