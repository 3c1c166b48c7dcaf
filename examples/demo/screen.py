"""The demonstration on the terminal: a live table, or plain lines without a terminal."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import nullcontext, suppress

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from examples.demo.fake_participant import FakeParticipant
from examples.demo.players import Actor, Adder, Listener, Talker
from examples.demo.ros2_acts import Ros2Listener, Ros2Talker
from examples.demo.scenario import AnyListener, AnyTalker, Scenario

EVENTS_SHOWN = 6


def state_of(node: Actor | Ros2Talker | Ros2Listener) -> str:
    """The state of a node, in few words."""
    if not (node.listening if isinstance(node, FakeParticipant) else node.slave.listening):
        return "stopped"
    if isinstance(node, Adder):
        return "1 call" if node.answered == 1 else f"{node.answered} calls"
    if node.connected:
        return "connected"
    if isinstance(node, Talker | Ros2Talker):
        return "no subscriber"
    return (node.problem if isinstance(node, Listener) else "") or "no publisher"


def moments_of(node: AnyTalker | AnyListener) -> list[float]:
    """When a node sent or received its messages."""
    if isinstance(node, Talker | Ros2Talker):
        return [*node.sent.values()]
    return [moment for _, moment in node.received]


def rows(scenario: Scenario) -> Iterator[tuple[str, Actor | Ros2Talker | Ros2Listener, str, str]]:
    """Of each node: version of ROS, node, own address, and the address that the other side uses."""
    for node in scenario.nodes:
        address = f"{node.host}:{node.slave.address[1]}"
        yield "1", node, address, scenario.seen.get(node.name, "")
    for ros2_node in scenario.ros2.nodes:
        yield (
            "2",
            ros2_node,
            ", ".join(map(str, ros2_node.locators[1:])),
            scenario.ros2.seen(ros2_node),
        )


def frame(scenario: Scenario) -> Group:
    """The whole screen: the act, the nodes, and the last events."""
    title = f"{scenario.clock():5.1f} s  [rosproxy {scenario.proxy.state}]  {scenario.act}"
    table = Table(box=None, header_style="dim", padding=(0, 1, 0, 0))
    for name in ("ROS", "SIDE", "NODE", "CALLS ITSELF", "OTHER SIDE USES"):
        table.add_column(name, no_wrap=True)
    table.add_column("MSGS", justify="right", no_wrap=True)
    table.add_column("STATE")  # if the table is too wide, rich cuts this column alone
    for version, node, address, seen in rows(scenario):
        _, side, name = node.name.split("/")
        state = Text(state_of(node), no_wrap=True, overflow="ellipsis")
        number = "" if isinstance(node, Adder) else str(len(moments_of(node)))
        table.add_row(version, side, name, address, seen, number, state)
    events = Table.grid(padding=(0, 2, 0, 0))
    for moment, text in scenario.events[-EVENTS_SHOWN:]:
        events.add_row(f"{moment:5.1f} s", Text(text))
    return Group(Text(title, style="bold"), "", table, "", events)


def event_line(moment: float, text: str) -> str:
    """An event with its time."""
    return f"{moment:5.1f} s  {text}"


def counts_line(scenario: Scenario) -> str:
    """The act, and the received of the sent messages for each side."""
    counts = [
        f"{ros} {way.split()[-1]} {len(moments_of(listener))}/{len(moments_of(talker))}"
        for (ros, way), (talker, listener) in scenario.pairs.items()
    ]
    return event_line(scenario.clock(), f"[{scenario.act}] {'  '.join(counts)}")


async def show(scenario: Scenario, console: Console) -> None:
    """Draw until cancelled, and a last time then."""
    live = Live(console=console, auto_refresh=False) if console.is_terminal else None
    shown = 0
    with live or nullcontext():
        with suppress(asyncio.CancelledError):
            while True:
                shown = _draw(scenario, live or console, shown)
                await asyncio.sleep(0.2 if live else 1.0)
        _draw(scenario, live or console, shown)


def _draw(scenario: Scenario, on: Live | Console, shown: int) -> int:
    """Draw anew, or print the events after the first `shown`. Return the number of events."""
    if isinstance(on, Live):
        on.update(frame(scenario), refresh=True)
    else:
        for event in scenario.events[shown:]:
            on.out(event_line(*event), highlight=False)
        on.out(counts_line(scenario), highlight=False)
    return len(scenario.events)


def print_summary(scenario: Scenario, console: Console) -> None:
    """Print all checks with their results."""
    console.out("")
    for check in scenario.checks:
        verdict = ("ok    ", "green") if check.kept else ("FAILED", "red")
        text = Text.assemble(verdict, f"  {check.promise}: {check.detail}")
        console.print(text, soft_wrap=True)
    kept = sum(check.kept for check in scenario.checks)
    console.out(f"\n{kept} of {len(scenario.checks)} promises kept")
