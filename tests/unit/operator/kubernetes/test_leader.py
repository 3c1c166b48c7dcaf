"""Taking part in the choice of a leader, through the real client, against an API server here."""

import asyncio
import logging
from collections.abc import AsyncIterator

import pytest

from rosproxy_operator.common.operator_metrics import ClusterMetrics
from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.kubernetes import leader_election as module
from rosproxy_operator.kubernetes.api.api_client import Api, NotLeading
from rosproxy_operator.kubernetes.api.leader_gate import Gate
from rosproxy_operator.kubernetes.controller import KubernetesController
from rosproxy_operator.kubernetes.leader_election import LeaderElection
from rosproxy_operator.kubernetes.planner import leadership
from rosproxy_operator.kubernetes.resources.model import Name
from rosproxy_operator.kubernetes.run import hand_over
from rosproxy_operator.kubernetes.settings import KubernetesSettings
from tests.unit.operator.kubernetes.api_server import ApiServer, until

LEASE = Name("ros", "operator")
KEY = "leases", "operator", "ros"


@pytest.fixture(autouse=True)
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The clock, which stands still, and short pauses."""
    clock = [1000.0]
    monkeypatch.setattr(module, "clock", lambda: clock[0])
    monkeypatch.setattr(module, "RENEWAL_INTERVAL_S", 0.02)
    monkeypatch.setattr(module, "STANDBY_READ_INTERVAL_S", 0.02)
    return clock


class Candidates:
    """Some that take part, each in a task."""

    def __init__(self, api: Api) -> None:
        self.api = api
        self.tasks: dict[LeaderElection, asyncio.Task[None]] = {}
        self.changes = 0

    def join(self) -> LeaderElection:
        election = LeaderElection(self.api, LEASE, ClusterMetrics())
        self.tasks[election] = asyncio.create_task(election.run(self.changed))
        return election

    def changed(self) -> None:
        self.changes += 1

    async def kill(self, election: LeaderElection) -> None:
        task = self.tasks.pop(election)
        async with election._lock:  # no request is under way
            task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    def leaders(self) -> list[LeaderElection]:
        return [election for election in self.tasks if election.leads()]


@pytest.fixture
async def candidates(api: Api, server: ApiServer) -> AsyncIterator[Candidates]:
    server.put("leases", {"metadata": {"name": "operator"}}, "ros")
    participants = Candidates(api)
    yield participants
    for election in [*participants.tasks]:
        await participants.kill(election)


async def test_one_of_two_leads(candidates: Candidates, server: ApiServer) -> None:
    first = candidates.join()
    await until(first.leads)
    second = candidates.join()
    spec = server.get(*KEY)["spec"]
    renewed = spec["renewTime"]
    await until(lambda: server.get(*KEY)["spec"]["renewTime"] != renewed)
    assert (first.term(), second.term()) == (1, 0)
    assert spec["leaseTransitions"] == 1
    assert spec["leaseDurationSeconds"] == leadership.LEASE_DURATION_S


async def test_the_lease_names_the_pod(
    candidates: Candidates, server: ApiServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a host network, the host name is that of the node."""
    monkeypatch.setenv("POD_NAME", "rosproxy-operator-5d9f-x2k")
    await until(candidates.join().leads)
    assert server.get(*KEY)["spec"]["holderIdentity"].startswith("rosproxy-operator-5d9f-x2k_")


async def test_another_one_leads_when_it_is_killed(
    candidates: Candidates, server: ApiServer, now: list[float]
) -> None:
    first = candidates.join()
    await until(first.leads)
    second = candidates.join()
    await candidates.kill(first)
    last = server.get(*KEY)["metadata"]["resourceVersion"]
    await until(
        lambda: second._candidate.record is not None and second._candidate.record.version == last
    )
    now[0] += leadership.RENEWAL_DEADLINE_S
    assert candidates.leaders() == []
    assert not first.leads()
    now[0] += leadership.LEASE_DURATION_S
    await until(second.leads)
    assert server.get(*KEY)["spec"]["leaseTransitions"] == 2


async def test_another_one_leads_at_once_when_it_is_released(candidates: Candidates) -> None:
    """No time passes here."""
    first = candidates.join()
    await until(first.leads)
    second = candidates.join()
    first.resign()
    assert not first.leads()
    await first.release()
    await until(second.leads)
    assert not first.leads()


async def test_a_leader_that_cannot_renew_stops(
    candidates: Candidates, server: ApiServer, now: list[float], caplog: pytest.LogCaptureFixture
) -> None:
    """It leads again, in a new term, as soon as renewal works."""
    caplog.set_level(logging.INFO)
    election = candidates.join()
    await until(election.leads)
    server.refuse("PATCH", "leases", 403, "patch is not for you")
    now[0] += leadership.RENEWAL_DEADLINE_S
    assert election.term() == 0
    await until(lambda: "stands by: no operator leads" in caplog.text)
    assert caplog.text.count("patch is not for you") == 1
    server.refusals.clear()
    await until(election.leads)
    assert election.term() == 2


async def test_a_lease_that_was_taken_away_is_made_anew(
    candidates: Candidates, server: ApiServer, now: list[float]
) -> None:
    election = candidates.join()
    await until(election.leads)
    server.forget(*KEY)
    await until(lambda: not election.leads())
    await until(lambda: election._candidate.record is not None)
    now[0] += leadership.LEASE_DURATION_S
    await until(election.leads)


async def test_one_that_is_stopped_acts_no_more_and_then_gives_the_lead_away(
    candidates: Candidates, server: ApiServer, api: Api
) -> None:
    election = candidates.join()
    await until(election.leads)
    api.gate.open = election.leads
    controller = KubernetesController(KubernetesSettings(), api, ClusterMetrics(), election.term)
    with api.gate.passing() as may:
        assert may
        handing = asyncio.create_task(hand_over(api, controller, election))
        await until(lambda: not election.leads())
        assert server.get(*KEY)["spec"]["holderIdentity"]
    await handing
    assert server.get(*KEY)["spec"]["holderIdentity"] == ""
    with pytest.raises(NotLeading):
        await in_thread(api.delete, "pods", Name("ros", "a"), "uid")


async def test_alone_it_always_leads(api: Api) -> None:
    election = LeaderElection(api, None, ClusterMetrics())
    election.resign()
    assert election.term() == 1


async def test_nothing_is_written_by_one_that_does_not_lead(api: Api, server: ApiServer) -> None:
    """But the Lease itself; and everything is read."""
    server.put("pods", {"metadata": {"name": "a"}}, "ros")
    api.gate.open = lambda: False
    with pytest.raises(NotLeading):
        await in_thread(api.delete, "pods", Name("ros", "a"), "uid")
    with pytest.raises(NotLeading):
        await in_thread(api.create, "pods", {"metadata": {"namespace": "ros", "name": "b"}})
    with pytest.raises(NotLeading):
        await in_thread(api.evict, Name("ros", "a"), "uid")
    await in_thread(api.get, "pods", Name("ros", "a"))
    await in_thread(api.create, "leases", {"metadata": {"namespace": "ros", "name": "b"}})
    assert [method for method, _, _ in server.requests] == ["GET", "POST"]


async def test_what_is_under_way_is_waited_for() -> None:
    gate = Gate()
    with gate.passing() as may:
        assert may
        closing = asyncio.create_task(in_thread(gate.close, 30.0))
        await until(lambda: gate._closed)
        with gate.passing() as late:
            assert not late
        assert not closing.done()
    assert await closing


async def test_what_does_not_end_is_not_waited_for() -> None:
    gate = Gate()
    with gate.passing():
        assert not await in_thread(gate.close, 0.0)
