"""A problem of the kernel plane lasts until the kernel forwards."""

import asyncio
import logging
import time
from collections.abc import Mapping
from types import MappingProxyType, SimpleNamespace
from typing import Any, cast

import pytest

from rosproxy.forwarding.kernel import plane
from rosproxy.forwarding.kernel.decisions import Changes
from rosproxy.forwarding.kernel.plane import KernelPlane
from rosproxy.forwarding.kernel.syncer import (
    DATAGRAM_PAUSE_S,
    LINES_PERIOD_S,
    LOST_TABLE_RETRY_S,
    MOST_LINES,
    Clock,
)
from rosproxy.forwarding.kernel.tools import ToolError
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.output.problems import Problems
from tests.run_options import parse_settings


class FailingTable:
    """A table that `begin` makes, and that is lost later."""

    has_connections = True
    weakness = ""
    tools = None
    table = SimpleNamespace(name="rosproxy")
    forwards: Mapping[int, Any] = MappingProxyType({})

    async def begin(self, surroundings: Any) -> None:
        pass

    async def change(self, *arguments: Any) -> None:
        raise ToolError("nft is gone")

    make = change


class NoHolders(tuple[Any, ...]):
    """An empty registry."""

    by_port: Mapping[int, Any] = MappingProxyType({})


class NoTasks:
    """Tasks that never run."""

    def repeat(self, *arguments: Any) -> None:
        pass


def kernel_plane(
    monkeypatch: pytest.MonkeyPatch,
    problems: Problems,
    obstacle: str = "",
    clock: Clock = time.monotonic,
) -> KernelPlane:
    async def find_obstacle(*arguments: Any) -> str:
        return obstacle

    monkeypatch.setattr(plane, "find_obstacle", find_obstacle)
    settings = parse_settings(
        {"master_uri": "http://robot:1", "advertise_host": "192.0.2.1", "data_plane": "kernel"}
    )
    table = cast(Any, FailingTable())
    tasks = cast(Any, NoTasks())
    return KernelPlane(settings, cast(Any, NoHolders()), tasks, problems, clock, table)


async def test_that_the_kernel_can_not_forward_is_no_event(monkeypatch: pytest.MonkeyPatch) -> None:
    """After 5 minutes, the condition Degraded no longer named the reason."""
    problems = Problems()
    await kernel_plane(monkeypatch, problems, "nft is missing").start()
    (problem,) = problems.all()
    assert problem.text.endswith("not the kernel: nft is missing")
    assert problem.holds


async def test_a_lost_table_is_a_problem_until_the_table_is_regained(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problems = Problems()
    now = 0.0
    kernel = kernel_plane(monkeypatch, problems, clock=lambda: now)
    await kernel.start()
    kernel.syncer.note_change()
    await kernel.syncer.run_once()
    (problem,) = problems.all()
    assert problem.text == "the kernel no longer forwards topics: nft is gone"
    assert problem.holds
    now = LOST_TABLE_RETRY_S + 1
    await kernel.look()
    assert problems.all() == []


def test_the_log_names_so_many_changed_forwards_and_no_more(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A participant may change its ports again and again, and each port was a line."""
    now = 0.0
    syncer = kernel_plane(monkeypatch, Problems(), clock=lambda: now).syncer
    caplog.set_level(logging.INFO)
    for port in range(MOST_LINES):
        syncer._log(Changes({port: HostPort("172.30.0.5", 7411)}, {}))
        syncer._log(Changes({}, {port: HostPort("172.30.0.5", 7412)}))
    assert len(caplog.records) == MOST_LINES
    now = LINES_PERIOD_S
    syncer._log(Changes({}, {11400: HostPort("172.30.0.5", 7413)}))
    assert [record.message for record in caplog.records[MOST_LINES:]] == [
        "200 more forwards of topics have changed; the log names 200 in 60 s",
        "a node that has ended: the kernel forwards port 11400 to 172.30.0.5:7413",
    ]


def test_the_log_counts_changed_forwards_also_if_no_more_change(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    now = 0.0
    syncer = kernel_plane(monkeypatch, Problems(), clock=lambda: now).syncer
    caplog.set_level(logging.INFO)
    syncer._log(Changes({}, {p: HostPort("172.30.0.5", p) for p in range(MOST_LINES + 7)}))
    syncer.look_around()
    assert len(caplog.records) == MOST_LINES
    now = LINES_PERIOD_S
    for _ in range(2):
        syncer.look_around()
    assert [record.message for record in caplog.records[MOST_LINES:]] == [
        "7 more forwards of topics have changed; the log names 200 in 60 s"
    ]


@pytest.mark.parametrize(("has_connections", "pauses"), [(True, []), (False, [DATAGRAM_PAUSE_S])])
async def test_ports_for_datagrams_are_not_compared_all_the_time(
    monkeypatch: pytest.MonkeyPatch, has_connections: bool, pauses: list[float]
) -> None:
    """A comparison of 875 ports takes 18 ms, and each announcement may change ports.

    A subscriber of ROS 1 waits for its forward, so there is no pause.
    """
    monkeypatch.setattr(FailingTable, "has_connections", has_connections)
    kernel = kernel_plane(monkeypatch, Problems())
    await kernel.start()
    slept = list[float]()

    async def sleep(seconds: float) -> None:
        slept.append(seconds)

    monkeypatch.setattr(asyncio, "sleep", sleep)
    kernel.syncer.note_change()
    await kernel.syncer.run_once()
    assert slept == pauses
