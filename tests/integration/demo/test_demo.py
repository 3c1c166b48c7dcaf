"""The complete demo, in a short form, and how it ends when something goes wrong."""

import json
import signal
import subprocess
import sys

import pytest

from rosproxy.demo import cast
from rosproxy.demo.__main__ import perform
from rosproxy.demo.layout import detect, names_only
from rosproxy.demo.screen import summary

DEMO = [sys.executable, "-m", "rosproxy.demo", "--seconds", "4"]


def finish(timeout, *options):
    command = [*DEMO, *options]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)


def test_the_short_demo_meets_every_expectation():
    run = finish(60, "--json")
    outcome = json.loads(run.stdout)
    failed = [item for item in outcome["expectations"] if not item["met"]]
    assert (failed, outcome["log"]) == ([], [])
    assert (run.returncode, outcome["ok"], run.stderr) == (0, True, "")
    for stream in outcome["evidence"]["streams"]:
        assert stream["received"] > 20
    assert outcome["evidence"]["message_recovery"] < 2
    assert len(outcome["evidence"]["addresses_after"]) == 3


async def test_the_demo_works_where_only_names_separate_the_sides():
    outcome = await perform(4, names_only(), quiet=True)
    assert outcome.ok, summary(outcome.verdicts, color=False)


async def test_a_proxy_that_does_not_start_is_named(monkeypatch):
    monkeypatch.setattr(cast, "proxy_options", lambda *_: ["--port-range=wrong"])
    outcome = await perform(4, detect(), quiet=True)
    assert not outcome.ok
    assert outcome.verdicts[0].detail == "the proxy ended instead of starting"
    assert any("--port-range" in line for line in outcome.log)


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_demo_leaves_no_process(stop):
    with subprocess.Popen(DEMO, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as demo:
        assert demo.stdout is not None
        lines = iter(demo.stdout)
        master = next(line.split()[-2].rstrip(",") for line in lines if "ROS master at" in line)
        next(line for line in lines if "service call" in line)
        assert master in _commands()
        demo.send_signal(stop)
        _, errors = demo.communicate(timeout=20)
    assert (demo.returncode, errors) == (130, "interrupted; all processes ended\n")
    assert master not in _commands()


def _commands():
    """The command lines of all processes; the demo's carry the address of its master."""
    return subprocess.run(
        ["ps", "-axww", "-o", "command"], capture_output=True, text=True, check=True
    ).stdout


def test_wrong_options_are_refused():
    run = finish(20, "--seconds", "0")
    assert run.returncode == 2
    assert "--seconds" in run.stderr
