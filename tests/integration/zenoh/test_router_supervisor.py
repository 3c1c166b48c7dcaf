"""The router process: restarted after its end, killed if hanging, with a reported reason.

Small programs stand in for the router process, which needs the zenoh library.
"""

import asyncio
import os
import signal
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.tasks import Tasks
from rosproxy.zenoh import router_supervisor
from rosproxy.zenoh.protocol.report import Report
from rosproxy.zenoh.router_supervisor import RoutersFailed, RouterSupervisor
from tests.integration.net import until

REPORTS = """
import os, sys, time
config = sys.stdin.readline()
while True:
    print('{"tokens": ["%d"]}' % os.getpid(), flush=True)
    time.sleep(0.05)
"""
FAILS = """
print('{"error": "Can not create a new TCP listener: Address already in use"}', flush=True)
"""
CONFIRMS = """
import json, sys
for line in sys.stdin:
    told = json.loads(line)
    report = {"revision": told["revision"], "tokens": [json.dumps(told["routers"])]}
    print(json.dumps(report), flush=True)
"""
ECHOES = """
import json, sys
for line in sys.stdin:
    print(json.dumps({"tokens": [line.strip()]}), flush=True)
"""
HANGS = "import time; time.sleep(60)"
TALKS = 'print("no report", flush=True)'
ENDS = "import sys; sys.stderr.write('thread panicked\\n'); sys.exit(3)"

CONFIGS = [{"mode": '"router"'}]


class Kept:
    """A supervisor with a small program as the router process."""

    def __init__(self, tasks: Tasks, program: str) -> None:
        self.reports: list[Report] = []
        self.supervisor = RouterSupervisor(tasks, self._take)
        self.supervisor.program = (sys.executable, "-c", program)

    async def _take(self, report: Report) -> None:
        self.reports.append(report)

    @property
    def pid(self) -> int:
        """The process of the last report."""
        (pid,) = self.reports[-1].tokens or ()
        return int(pid)


@pytest.fixture
async def tasks() -> AsyncIterator[Tasks]:
    tasks = Tasks()
    yield tasks
    await tasks.cancel()


async def test_reports_are_taken_and_the_process_ends_with_the_tasks(tasks: Tasks) -> None:
    kept = Kept(tasks, REPORTS)
    await kept.supervisor.start(CONFIGS)
    assert (kept.supervisor.failure, kept.supervisor.restarts) == ("", 0)
    pid = kept.pid
    await tasks.cancel()
    assert not Path(f"/proc/{pid}").exists()


async def test_a_process_that_is_killed_starts_again(
    tasks: Tasks, caplog: pytest.LogCaptureFixture
) -> None:
    kept = Kept(tasks, REPORTS)
    await kept.supervisor.start(CONFIGS)
    first = kept.pid
    os.kill(first, signal.SIGKILL)
    await until(lambda: kept.pid != first, "another process reports")
    assert kept.supervisor.restarts == 1
    assert kept.supervisor.failure == ""
    assert "zenoh routers ended: the process was ended by SIGKILL" in caplog.text


@pytest.mark.parametrize(
    ("program", "reason"),
    [
        (FAILS, "Can not create a new TCP listener: Address already in use"),
        (HANGS, "no report for 0.2 s"),
        (TALKS, "a report that is not valid"),
        (ENDS, "the process ended with status 3"),
    ],
)
async def test_the_reason_of_a_failed_start_is_told(
    tasks: Tasks,
    program: str,
    reason: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    if program is HANGS:
        monkeypatch.setattr(router_supervisor, "START_TIMEOUT_S", 0.2)
    with pytest.raises(RoutersFailed, match=reason):
        await Kept(tasks, program).supervisor.start(CONFIGS)
    if program is ENDS:
        assert "zenoh: thread panicked" in caplog.text


async def test_a_process_that_falls_silent_is_killed(
    tasks: Tasks, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(router_supervisor, "REPORT_TIMEOUT_S", 0.5)
    kept = Kept(tasks, REPORTS)
    await kept.supervisor.start(CONFIGS)
    first = kept.pid
    os.kill(first, signal.SIGSTOP)
    await until(lambda: kept.pid != first, "another process reports")
    assert not Path(f"/proc/{first}").exists()
    assert "zenoh routers ended: no report for 0.5 s" in caplog.text


async def test_a_process_that_can_not_start_is_told(tasks: Tasks) -> None:
    kept = Kept(tasks, REPORTS)
    kept.supervisor.program = ("/nothing/here",)
    with pytest.raises(RoutersFailed, match="can't be started: No such file or directory"):
        await kept.supervisor.start(CONFIGS)
    kept.supervisor.program = (sys.executable, "-c", REPORTS)
    await until(lambda: kept.reports, "the next start succeeds")


async def test_what_the_library_prints_is_logged_up_to_a_bound(
    tasks: Tasks, caplog: pytest.LogCaptureFixture
) -> None:
    program = "import sys\nfor _ in range(99): print('panic\\x1b', file=sys.stderr)\n" + REPORTS
    await Kept(tasks, program).supervisor.start(CONFIGS)
    await until(lambda: "zenoh: panic" in caplog.text, "a line is logged")
    await asyncio.sleep(0.1)
    assert caplog.text.count("zenoh: panic") == router_supervisor.MOST_LOG_LINES
    assert "\x1b" not in caplog.text


async def test_other_configurations_are_in_force_when_use_returns(tasks: Tasks) -> None:
    kept = Kept(tasks, CONFIRMS)
    await kept.supervisor.start(CONFIGS)
    for mode in ("a", "b"):
        await kept.supervisor.use([{"mode": mode}])
        assert kept.reports[-1].tokens == (f'[{{"mode": "{mode}"}}]',)
    assert kept.supervisor.restarts == 0


async def test_the_process_is_asked_to_end_connections(tasks: Tasks) -> None:
    kept = Kept(tasks, ECHOES)
    kept.supervisor.end_connections([HostPort("192.0.2.7", 7447)])  # no process runs yet
    await kept.supervisor.start(CONFIGS)
    kept.supervisor.end_connections([HostPort("192.0.2.7", 7447)])
    expected = '{"end": [["192.0.2.7", 7447]]}'
    await until(lambda: kept.reports[-1].tokens == (expected,), "the process has the line")


async def test_a_process_that_does_not_confirm_is_replaced(
    tasks: Tasks, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Its routers would go on with former rules."""
    monkeypatch.setattr(router_supervisor, "CHANGE_TIMEOUT_S", 0.2)
    kept = Kept(tasks, REPORTS)
    await kept.supervisor.start(CONFIGS)
    first = kept.pid
    await kept.supervisor.use([{"mode": "b"}])
    assert not Path(f"/proc/{first}").exists()
    assert "do not confirm a change" in caplog.text
    kept.supervisor.program = (sys.executable, "-c", CONFIRMS)
    await until(lambda: kept.reports[-1].revision == 2, "the next process has the change")
    assert kept.reports[-1].tokens == ('[{"mode": "b"}]',)
