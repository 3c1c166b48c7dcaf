"""The executor runs jobs of different places at the same time, and retries failed jobs."""

import asyncio
import logging
from collections.abc import AsyncIterator

import pytest

from rosproxy.shared.tasks import Tasks
from rosproxy_operator.docker.errors import EngineError, PortTaken
from rosproxy_operator.docker.executor import Executor
from rosproxy_operator.docker.planner.actions import Action, Connect, CreateNetwork, Remove, Start
from rosproxy_operator.docker.planner.plan import Group
from rosproxy_operator.proxy_spec.place import Master, Place

ONE = Place(Master("http://one:11311"), "192.0.2.1")
OTHER = Place(Master("http://other:11311"), "192.0.2.1")
UPLINK = Group(None, (CreateNetwork("0-rosproxy"),))


class Host:
    """Notes what is carried out; does what ``does`` says for an action."""

    def __init__(self) -> None:
        self.done: list[Action] = []
        self.does: dict[Action, Exception | asyncio.Event] = {}
        self.taken: list[tuple[str, int | None]] = []
        self.outcomes: list[str] = []
        self.finished = asyncio.Event()
        self.tasks = Tasks()
        self.time = 100.0
        self.work = Executor(
            self.tasks,
            self.finished.set,
            lambda name, port: self.taken.append((name, port)),
            lambda action, outcome: self.outcomes.append(outcome),
            self.now,
        )

    def now(self) -> float:
        """A clock by which nothing takes time."""
        self.time += 1e-6
        return self.time

    async def carry_out(self, action: Action) -> None:
        behaviour = self.does.get(action)
        if isinstance(behaviour, asyncio.Event):
            await behaviour.wait()
        elif behaviour is not None:
            raise behaviour
        self.done.append(action)

    async def start(self, *groups: Group) -> None:
        """Begin, and wait until something is over."""
        self.begin(*groups)
        await asyncio.wait_for(self.finished.wait(), 30)

    def begin(self, *groups: Group) -> None:
        self.finished.clear()
        self.work.start(groups, self.carry_out, self.now())


@pytest.fixture
async def host() -> AsyncIterator[Host]:
    host = Host()
    yield host
    await host.tasks.cancel()


async def test_a_group_is_carried_out_in_order(host: Host) -> None:
    await host.start(Group(ONE, (Start("a"), Start("b"))), Group(ONE, (Start("c"),)))
    assert host.done == [Start("a"), Start("b"), Start("c")]
    assert host.outcomes == ["ok"] * 3
    assert not host.work.busy
    assert not host.work.problems
    assert host.work.again_in is None


async def test_the_uplink_comes_first(host: Host) -> None:
    uplink_ready = asyncio.Event()
    host.does[UPLINK.actions[0]] = uplink_ready
    host.begin(UPLINK, Group(ONE, (Start("a"),)))
    await asyncio.sleep(0.01)
    assert host.done == []
    uplink_ready.set()
    while host.work.busy:
        await asyncio.sleep(0.01)
    assert host.done == [UPLINK.actions[0], Start("a")]


async def test_a_slow_job_holds_up_no_job_of_another_place(host: Host) -> None:
    host.does[Start("slow")] = asyncio.Event()
    slow = Group(ONE, (Start("slow"),))
    host.begin(slow)
    await host.start(slow, Group(OTHER, (Start("a"),)))
    assert host.done == [Start("a")]
    assert host.work.busy


async def test_what_fails_ends_its_group_and_is_tried_again_later(host: Host) -> None:
    host.does[Start("a")] = EngineError("no")
    group = Group(ONE, (Start("a"), Start("b")), fix="do this")
    await host.start(group, Group(OTHER, (Start("c"),)))
    while host.work.busy:
        await asyncio.sleep(0.01)
    assert host.done == [Start("c")]
    (problem,) = host.work.problems
    assert problem.subject.startswith("proxy rosproxy-one-")
    assert problem.message.endswith(": no. do this")
    assert 0.5 < (host.work.again_in or 0) <= 1.0
    host.begin(group)
    assert not host.work.busy
    host.time += 1.0
    host.begin(group)
    assert host.work.busy


async def test_a_failure_that_keeps_nothing_from_anybody_is_a_warning(host: Host) -> None:
    host.does[Start("a")] = EngineError("no")
    await host.start(Group(ONE, (Start("a"),), "conntrack entries", fatal=False))
    (problem,) = host.work.problems
    assert not problem.fatal


async def test_other_actions_are_tried_at_once(host: Host) -> None:
    host.does[Start("a")] = EngineError("no")
    await host.start(Group(ONE, (Start("a"),)))
    await host.start(Group(ONE, (Start("b"),)))
    assert host.done == [Start("b")]
    assert not host.work.problems


async def test_a_problem_ends_when_nothing_is_to_be_done_any_more(host: Host) -> None:
    host.does[Start("a")] = EngineError("no")
    await host.start(Group(ONE, (Start("a"),)))
    host.begin()
    assert not host.work.problems


async def test_a_network_that_cannot_be_joined_does_not_end_the_group(host: Host) -> None:
    join = Connect("a", "app", ())
    host.does[join] = EngineError("no")
    await host.start(Group(ONE, (join, Start("a"), Remove("b", ""))))
    assert host.done == [Start("a"), Remove("b", "")]
    assert len(host.work.problems) == 1


async def test_the_first_cause_stays_visible(host: Host) -> None:
    connect = Connect("a", "app", ())
    host.does[connect] = EngineError("network not found")
    host.does[Start("a")] = EngineError("no")
    await host.start(Group(ONE, (connect, Start("a"))))
    (problem,) = host.work.problems
    assert problem.message.endswith(": network not found")


async def test_a_port_that_is_taken_is_no_failure_but_told(host: Host) -> None:
    host.does[Start("a")] = PortTaken("taken", 11405)
    await host.start(Group(ONE, (Start("a"), Start("b"))))
    assert host.taken == [("a", 11405)]
    assert host.outcomes == ["taken"]
    assert host.done == []
    assert not host.work.problems
    assert host.work.again_in is None


async def test_a_look_that_began_before_work_was_over_is_not_acted_upon(host: Host) -> None:
    began = host.now()
    await host.start(Group(ONE, (Start("a"),)))
    host.work.start([Group(ONE, (Start("a"),))], host.carry_out, began)
    assert not host.work.busy


async def test_what_is_tried_again_and_again_is_logged_once(
    host: Host, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    host.does[Start("a")] = PortTaken("taken", 11405)
    for _ in range(3):
        await host.start(Group(ONE, (Start("a"),)))
    assert [record.levelname for record in caplog.records] == ["INFO", "WARNING"]


async def test_a_mistake_of_ours_is_a_problem_and_not_a_loop(
    host: Host, caplog: pytest.LogCaptureFixture
) -> None:
    host.does[Start("a")] = TypeError("oops")
    await host.start(Group(ONE, (Start("a"),)))
    assert host.work.problems[0].message == "the operator failed: TypeError('oops')"
    assert (host.work.again_in or 0) > 0.5
    assert "Traceback" in caplog.text
