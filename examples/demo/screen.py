"""The demonstration on the terminal: a live table, or plain lines where there is none."""

from __future__ import annotations

import asyncio
from contextlib import nullcontext, suppress
from time import monotonic

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from examples.demo.players import Actor, Adder, Listener, Talker
from examples.demo.scenario import Scenario

EVENTS_SHOWN = 8


def state_of(node: Actor) -> str:
    """What a node is up to, in few words."""
    if not node.slave.listening:
        return "stopped"
    if isinstance(node, Adder):
        return "1 call" if node.answered == 1 else f"{node.answered} calls"
    if isinstance(node, Listener):
        return "connected" if node.connected else node.problem or "no publisher"
    unheard = node.number - len(node.sent)
    state = "connected" if node.subscribers else "nobody listens"
    return f"{state}, {unheard} unheard" if unheard else state


def moments_of(node: Talker | Listener) -> list[float]:
    """When a node sent or received its messages."""
    if isinstance(node, Talker):
        return [*node.sent.values()]
    return [moment for _, moment in node.received]


def frame(scenario: Scenario) -> Group:
    """The whole screen: what is being played, the nodes, and what happened last."""
    title = f"{scenario.clock():5.1f} s  [rosproxy {scenario.proxy.state}]  {scenario.act}"
    table = Table(box=None, header_style="dim")
    for name in ("SIDE", "NODE", "CALLS ITSELF", "OTHER SIDE USES"):
        table.add_column(name)
    for name in ("SENT", "RECV", "RATE"):
        table.add_column(name, justify="right")
    table.add_column("STATE", no_wrap=True)
    for node in scenario.nodes:
        _, side, name = node.name.split("/")
        counts = ["", "", ""]
        if not isinstance(node, Adder):
            moments = moments_of(node)
            counts[isinstance(node, Listener)] = str(len(moments))
            counts[2] = f"{sum(moment > monotonic() - 1 for moment in moments[-100:])}/s"
        address = f"{node.host}:{node.slave.address[1]}"
        seen = scenario.seen.get(node.name)
        table.add_row(side, name, address, seen, *counts, Text(state_of(node)))
    events = [Text(event_line(*event)) for event in scenario.events[-EVENTS_SHOWN:]]
    return Group(Text(title, style="bold"), "", table, "", *events)


def event_line(moment: float, text: str) -> str:
    """An event with its time."""
    return f"{moment:5.1f} s  {text}"


def counts_line(scenario: Scenario) -> str:
    """Where the play is and what has been counted so far."""
    counts = [
        f"{node.name[1:].replace('/', ' ')}: {len(moments_of(node))} ({state_of(node)})"
        for node in scenario.nodes
        if not isinstance(node, Adder)
    ]
    return event_line(scenario.clock(), f"[{scenario.act}] {'  '.join(counts)}")


async def show(scenario: Scenario, console: Console) -> None:
    """Draw until cancelled, and once more then."""
    live = Live(console=console, auto_refresh=False) if console.is_terminal else None
    shown = 0
    with live or nullcontext():
        with suppress(asyncio.CancelledError):
            while True:
                shown = _draw(scenario, live or console, shown)
                await asyncio.sleep(0.2 if live else 1.0)
        _draw(scenario, live or console, shown)


def _draw(scenario: Scenario, on: Live | Console, shown: int) -> int:
    """Draw anew, or print the events since the first `shown` ones; how many there are by now."""
    if isinstance(on, Live):
        on.update(frame(scenario), refresh=True)
    else:
        for event in scenario.events[shown:]:
            on.out(event_line(*event), highlight=False)
        on.out(counts_line(scenario), highlight=False)
    return len(scenario.events)


def print_summary(scenario: Scenario, console: Console) -> None:
    """Print what was shown, and what did not work."""
    console.out("")
    for check in scenario.checks:
        word = ("ok    ", "green") if check.kept else ("FAILED", "red")
        text = Text.assemble(word, f"  {check.promise}: {check.detail}")
        console.print(text, soft_wrap=True)
    kept = sum(check.kept for check in scenario.checks)
    console.out(f"\n{kept} of {len(scenario.checks)} promises kept")
