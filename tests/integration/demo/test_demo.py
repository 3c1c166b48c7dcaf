"""The complete demonstration in a short form, and its end after a fault."""

import asyncio
import io
import json
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from rich.console import Console

from examples.demo.fake_http import value
from examples.demo.players import Listener, Player, Talker
from examples.demo.proxy_process import ProxyProcess
from examples.demo.scenario import NAMES_ONLY, Scenario, count
from examples.demo.screen import frame, print_summary, show

DEMO = [sys.executable, "-m", "examples.demo", "--seconds", "4"]
PROMISES = 10


def finish(timeout, *options):
    command = [*DEMO, *options]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)


def failed(scenario):
    return [check for check in scenario.checks if not check.kept]


def test_two_short_demos_at_once_keep_every_promise():
    with ThreadPoolExecutor() as at_once:
        runs = list(at_once.map(lambda _: finish(120, "--json"), range(2)))
    for run in runs:
        outcome = json.loads(run.stdout)
        broken = [check for check in outcome["checks"] if not check["kept"]]
        assert (broken, outcome["log"], run.stderr) == ([], [], "")
        assert (run.returncode, outcome["ok"], len(outcome["checks"])) == (0, True, PROMISES)


async def test_the_demo_works_where_only_names_separate_the_sides():
    scenario = Scenario(4, NAMES_ONLY)
    await scenario.play()
    assert failed(scenario) == []
    assert len(scenario.checks) == PROMISES - 1
    for _, listener in scenario.pairs.values():
        assert len(listener.received) > 20


async def test_a_proxy_that_does_not_start_is_named(monkeypatch):
    monkeypatch.setattr(Scenario, "proxy_options", lambda _: ["--port-range=wrong"])
    scenario = Scenario(4)
    await scenario.play()
    assert [check.detail for check in failed(scenario)] == ["the proxy isn't ready, but ended"]
    assert any("--port-range" in line for line in scenario.proxy.log)
    out = io.StringIO()
    print_summary(scenario, Console(file=out))
    assert "FAILED  the demonstration runs to its end: the proxy isn't ready" in out.getvalue()
    assert "2 of 3 promises kept" in out.getvalue()


@pytest.mark.parametrize(
    ("changed", "missed"),
    [
        (("--data-plane=splice", "--bind=127.0.2.1"), "messages flow again"),
        (("--ros=2", "--ros=1"), "ROS 2: messages flow again"),
    ],
)
async def test_a_proxy_that_comes_back_as_another_is_noticed(monkeypatch, changed, missed):
    """With other ports the proxy has lost all nodes, and no promise is kept."""
    before, after = changed
    start = ProxyProcess.start

    async def start_elsewhere(self):
        if self.state == "killed":
            monkeypatch.setattr("examples.demo.scenario.PATIENCE", 2.0)
            self.options = [after if option == before else option for option in self.options]
        return await start(self)

    monkeypatch.setattr(ProxyProcess, "start", start_elsewhere)
    scenario = Scenario(4)
    await scenario.play()
    assert [check.detail for check in failed(scenario)] == [f"{missed}: not within 2 s"]


async def test_what_did_not_work_is_named(monkeypatch):
    async def add_wrongly(*_):
        return 6

    monkeypatch.setattr(Player, "add", add_wrongly)
    scenario = Scenario(4, NAMES_ONLY)
    scenario.talker.answers["getPid"] = value([1, "", 7])
    await scenario.play()
    assert [check.promise for check in failed(scenario)] == [
        "ROS 1: service calls cross both ways before the kill",
        "ROS 1: the same ports serve the same nodes",
        "ROS 1: service calls cross both ways after the restart",
    ]
    assert not scenario.ok


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_demo_leaves_no_process(stop):
    with subprocess.Popen(DEMO, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as demo:
        assert demo.stdout is not None
        lines = iter(demo.stdout)
        master = next(line.split()[-2].rstrip(",") for line in lines if "ROS master at" in line)
        next(line for line in lines if "outside calls inside" in line)
        assert master in _commands()
        demo.send_signal(stop)
        _, errors = demo.communicate(timeout=60)
    assert (demo.returncode, errors) == (130, "interrupted; all processes ended\n")
    assert master not in _commands()


def _commands():
    """The command lines of all processes. The demo's proxy has the master's address."""
    command_lines = []
    for process in filter(str.isdecimal, os.listdir("/proc")):
        try:
            command_lines.append(Path(f"/proc/{process}/cmdline").read_text())
        except OSError:
            continue  # the process has ended
    return " ".join(command_lines)


def test_wrong_options_are_refused():
    run = finish(60, "--seconds", "0")
    assert run.returncode == 2
    assert "--seconds" in run.stderr


@pytest.mark.parametrize(
    ("sent", "before", "received", "kept", "told"),
    [
        ({1, 2}, {1, 2}, [1, 2], True, "sent 2, received 2"),
        ({1, 2}, {}, [1], False, "lost 1, duplicated 0"),
        ({1, 2, 3, 4}, {1, 2, 3}, [1, 4], True, "2 on the way when the proxy was killed"),
        ({1, 2, 3, 4}, {1, 2, 3}, [1, 3, 4], False, "lost 1"),
        ({1, 2, 3}, {1}, [1, 3], False, "lost 1"),
        ({1}, {1}, [1, 1], False, "lost 0, duplicated 1"),
        ({1}, {1}, [1, 2], False, "sent 1, received 2"),
        ({}, {}, [], False, "5 published while no subscriber was connected"),
    ],
)
def test_what_counts_as_lost_cut_off_duplicated_or_unheard(sent, before, received, kept, told):
    talker = Talker("/t", "", topic="/t")
    listener = Listener("/l", "", topic="/t")
    talker.number = 5
    talker.sent = dict.fromkeys(sent, 0.0)
    listener.received = [(number, 0.0) for number in received]
    fits, text = count(talker, listener, frozenset(before))
    assert fits is kept
    assert told in text


@pytest.fixture
def scenario():
    made = Scenario(4)
    made.act = "first act"
    made.talker.number = 12
    made.talker.sent = dict.fromkeys(range(3, 13), 0.0)
    made.listener.problem = "Connection refused"
    made.tell("it began")
    return made


def text_of(scenario, width):
    out = io.StringIO()
    Console(file=out, width=width).print(frame(scenario))
    return out.getvalue()


async def test_the_frame_has_the_act_the_nodes_and_the_events(scenario):
    for node in (scenario.talker, scenario.listener, scenario.adder):
        await node.start()
    scenario.adder.answered = 1
    text = text_of(scenario, 160)
    for node in (scenario.talker, scenario.listener, scenario.adder):
        await node.stop()
    for phrase in ("first act", "CALLS ITSELF", "talker.inside:", "it began", "1 call"):
        assert phrase in text
    rows = {tuple(line.split()[:3]): line for line in text.splitlines() if line.strip()}
    assert "10" in rows["1", "inside", "talker"]
    assert rows["1", "inside", "talker"].rstrip().endswith("no subscriber")
    assert rows["1", "inside", "listener"].rstrip().endswith("Connection refused")
    assert rows["1", "outside", "adder"].rstrip().endswith("stopped")


async def test_80_columns_show_all_addresses_whole(scenario):
    scenario.listener.problem = "a rather long reason " * 9
    scenario.seen = {node.name: "127.0.1.1:30001" for node in scenario.nodes}
    for node in (*scenario.nodes, *scenario.ros2.nodes):
        await node.start()
    text = text_of(scenario, 80)
    for node in (*scenario.nodes, *scenario.ros2.nodes):
        await node.stop()
    assert text.count(" 127.0.1.1:30001 ") == len(scenario.nodes)
    for node in scenario.nodes:
        assert f" {node.host}:{node.slave.address[1]} " in text
    for participant in scenario.ros2.nodes:
        assert f" {participant.locators[1]} " in text


async def test_without_a_terminal_each_event_is_told_once(scenario):
    out = io.StringIO()
    showing = asyncio.create_task(show(scenario, Console(file=out)))
    await asyncio.sleep(0)
    scenario.tell("it went on")
    showing.cancel()
    await showing
    assert out.getvalue().count("it began") == out.getvalue().count("it went on") == 1
    assert "ROS 1 outside 0/10" in out.getvalue()


async def test_on_a_terminal_it_is_drawn_in_place(scenario):
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, width=160)
    showing = asyncio.create_task(show(scenario, console))
    await asyncio.sleep(0)
    showing.cancel()
    await showing
    assert out.getvalue().count("first act") > 1
    assert "\x1b[1A" in out.getvalue()
