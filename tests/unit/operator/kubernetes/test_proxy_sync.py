"""Reports about proxies that start, answer, fall silent and go."""

import asyncio
from collections.abc import AsyncIterator, Collection, Iterable, Mapping, Sequence
from typing import Any

import pytest
from msgspec.structs import replace

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.documents.status_document import ProxyStatus, read_status
from rosproxy.shared.policy.layers import PolicyLayer
from rosproxy.shared.policy.rules import parse_rules
from rosproxy.shared.tasks import Tasks
from rosproxy_operator.common.proxy_client import PolicyRefused, ProxyClient, ProxyError
from rosproxy_operator.kubernetes.planner.briefing import Briefing
from rosproxy_operator.kubernetes.proxies import proxy_sync
from rosproxy_operator.kubernetes.proxies.proxy_sync import ClusterProxySync, token_for
from rosproxy_operator.kubernetes.resources.cluster import ProxyPod
from rosproxy_operator.kubernetes.resources.names import token_of
from rosproxy_operator.kubernetes.resources.objects import proxy_pod
from rosproxy_operator.kubernetes.run import logs_command
from tests.unit.operator.kubernetes.api_server import until
from tests.unit.operator.kubernetes.builders_api import proxy_obj

KEY = b"k" * 32
UP = {"master": {"up": True}, "nodes": []}
DOWN = {"master": {"up": False, "error": "refused"}, "nodes": []}


class Told(ProxyClient):
    """Proxies with answers of the test."""

    def __init__(self) -> None:
        super().__init__()
        self.says: dict[str, Any] | None = None
        self.hears = True
        self.asked = self.failing = 0
        self.told: list[Any] = []
        self.callers: list[Any] = []
        self.deaf = False
        self.former = True
        self.refusal = 0
        self.version = "1"
        self.listening = 0
        self.changed = asyncio.Event()
        self.waited: list[tuple[str, float]] = []
        self.policies: list[Any] = []
        self.refuses: ProxyError | None = None
        self.unreadable: ProxyError | None = None

    async def status(self, admin: HostPort) -> ProxyStatus:
        self.asked += 1
        if self.unreadable:
            raise self.unreadable
        self.failing -= 1
        if self.says is None or self.failing >= 0:
            raise ProxyError(f"{admin} refuses connections")
        return read_status(self.says)

    async def changes(
        self, admin: HostPort, token: str, since: str, within: float
    ) -> tuple[str, ProxyStatus]:
        self.waited.append((since, within))
        if self.former:
            raise ProxyError("no such path", status=404)
        if self.refusal:
            raise ProxyError("not now", status=self.refusal)
        if not within or since != self.version:
            return self.version, await self.status(admin)
        self.listening += 1
        try:
            await asyncio.wait_for(self.changed.wait(), within)
        finally:
            self.listening -= 1
        self.changed.clear()
        return self.version, await self.status(admin)

    async def send_containers(self, admin: HostPort, token: str, body: Any) -> dict[str, Any]:
        self.told.append(body)
        if not self.hears:
            raise ProxyError("its master is away", status=503)
        return {}

    async def send_policy(self, admin: HostPort, token: str, layers: Sequence[PolicyLayer]) -> None:
        self.policies.append((token, *layers))
        if self.refuses:
            raise self.refuses

    async def send_selected(
        self,
        admin: HostPort,
        token: str,
        addresses: Collection[str],
        peers: Collection[str] | None = None,
        former: Mapping[str, Sequence[int]] | None = None,
    ) -> None:
        self.callers.append((token, *addresses))
        self.peers = peers
        if self.deaf:
            raise ProxyError("unknown field selected")


class Talk:
    def __init__(self) -> None:
        self.proxies = Told()
        self.tasks = Tasks()
        self.changes = 0
        self.all = ClusterProxySync(self.tasks, self.proxies, self.changed)

    def changed(self, namespaces: Iterable[str]) -> None:
        assert [*namespaces] == ["robots"]
        self.changes += 1

    async def asked(self, times: int = 3) -> None:
        target = self.proxies.asked + times
        await until(lambda: self.proxies.asked >= target)


@pytest.fixture
async def talk(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Talk]:
    monkeypatch.setattr(proxy_sync, "POLL_INTERVAL_S", 0.01)
    monkeypatch.setattr(proxy_sync, "STARTING_POLL_INTERVAL_S", 0.01)
    monkeypatch.setattr(proxy_sync, "FORMER_POLL_INTERVAL_S", 0.01)
    conversation = Talk()
    yield conversation
    await conversation.tasks.cancel()


def proxy(ip: str = "10.244.1.7") -> ProxyPod:
    parsed = proxy_pod(proxy_obj(status={"phase": "Running", "podIP": ip}))
    assert parsed is not None
    return parsed


UID = proxy().pod.uid


async def test_an_answer(talk: Talk) -> None:
    talk.proxies.says = UP
    talk.all.follow([proxy()])
    await talk.asked()
    assert talk.all.reports[UID].master_up
    assert talk.changes == 1  # the same answer is no update


async def test_a_proxy_with_too_long_an_answer_keeps_its_last_report(talk: Talk) -> None:
    """The proxy still counts as answering, and gets no repeated updates."""
    node = {"nodes": ["/talker"], "address": "10.244.1.9:40001", "state": "ok"}
    talk.proxies.says = {**UP, "nodes": [node]}
    talk.all.follow([proxy()], KEY)
    talk.all.brief({UID: Briefing(callers=("10.244.1.9",))})
    await talk.asked()
    await until(lambda: bool(talk.proxies.callers))
    talk.proxies.unreadable = ProxyError("the answer is too long", is_unreadable=True)
    told = len(talk.proxies.callers)
    await talk.asked(5)
    report = talk.all.reports[UID]
    assert report.answered
    assert report.nodes == {"10.244.1.9": ("/talker",)}
    assert report.problems == ("the answer is too long",)
    assert len(talk.proxies.callers) == told
    talk.proxies.unreadable = None
    await talk.asked(2)
    assert talk.all.reports[UID].problems == ()


async def test_a_proxy_with_too_long_a_first_answer_does_not_answer(
    talk: Talk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(proxy_sync, "STARTING_S", 0.0)
    talk.proxies.unreadable = ProxyError("the answer is too long", is_unreadable=True)
    talk.all.follow([proxy()])
    await talk.asked()
    assert not talk.all.reports[UID].answered
    assert talk.all.reports[UID].error == "the answer is too long"


async def test_a_proxy_with_endless_changes_keeps_no_other_waiting(
    talk: Talk, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The operator waits before each further request."""
    waits: list[float] = []
    wait = proxy_sync.ProxyPoller._wait_for_update

    async def noted(poller: proxy_sync.ProxyPoller, seconds: float) -> None:
        waits.append(seconds)
        await wait(poller, 0.0)

    monkeypatch.setattr(proxy_sync.ProxyPoller, "_wait_for_update", noted)
    talk.proxies.former = False

    async def changes(*_: Any) -> tuple[str, ProxyStatus]:
        talk.proxies.asked += 1
        return str(talk.proxies.asked), read_status(UP)

    monkeypatch.setattr(talk.proxies, "changes", changes)
    talk.all.follow([proxy()])
    await talk.asked(20)
    assert waits.count(proxy_sync.LEAST_REPORT_INTERVAL_S) >= 15


async def test_one_that_is_just_starting_is_not_told(talk: Talk) -> None:
    talk.all.follow([proxy()])
    await talk.asked()
    talk.proxies.says = DOWN  # the proxy has not asked its master yet
    await talk.asked()
    assert talk.all.reports == {}
    assert talk.changes == 0
    talk.proxies.says = UP
    await talk.asked()
    assert talk.all.reports[UID].answered


@pytest.mark.parametrize("says", [None, DOWN])
async def test_one_that_never_gets_well_is_told_of(
    talk: Talk, says: dict[str, Any] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(proxy_sync, "STARTING_S", 0.05)
    talk.proxies.says = says
    talk.all.follow([proxy()])
    await until(lambda: UID in talk.all.reports)
    assert not talk.all.reports[UID].master_up
    assert "refuse" in talk.all.reports[UID].error


async def test_one_unanswered_question_is_no_silence(talk: Talk) -> None:
    talk.proxies.says = UP
    talk.all.follow([proxy()])
    await talk.asked()
    talk.proxies.failing = 1
    await talk.asked()
    assert talk.changes == 1
    talk.proxies.says = None
    await talk.asked()
    assert not talk.all.reports[UID].answered
    assert talk.changes == 2


async def test_updates_are_repeated_until_they_are_heard(talk: Talk) -> None:
    talk.proxies.says = UP
    talk.proxies.hears = False
    talk.all.follow([proxy()])
    talk.all.brief({UID: Briefing(gone=("10.0.0.2",)), "nobody": Briefing(gone=("10.0.0.3",))})
    await until(lambda: len(talk.proxies.told) > 2)
    talk.all.brief({UID: Briefing(gone=("10.0.0.1",))})
    talk.proxies.hears = True
    changes = talk.changes
    await until(lambda: talk.proxies.told[-1] == {"gone": ["10.0.0.1", "10.0.0.2"]})
    count = len(talk.proxies.told)
    await talk.asked()
    assert len(talk.proxies.told) == count
    assert talk.changes == changes + 1  # another look, whether the nodes are still there


async def test_who_is_not_there_any_more_is_forgotten(talk: Talk) -> None:
    talk.proxies.says = UP
    talk.all.follow([proxy()])
    await talk.asked()
    talk.all.follow([])
    assert talk.all.reports == {}
    await asyncio.sleep(0.03)
    asked = talk.proxies.asked
    await asyncio.sleep(0.05)
    assert talk.proxies.asked == asked


async def test_another_address_is_another_poller(talk: Talk) -> None:
    talk.proxies.says = UP
    talk.all.follow([proxy()])
    await talk.asked()
    talk.all.follow([proxy("10.244.1.8")])
    assert talk.all.reports == {}


async def test_no_address_no_poller(talk: Talk) -> None:
    running = proxy()
    ended = replace(running, pod=replace(running.pod, phase="Failed"))
    talk.all.follow([proxy(""), ended])
    await asyncio.sleep(0.05)
    assert talk.proxies.asked == 0


async def test_the_proxy_gets_the_allowed_callers(talk: Talk) -> None:
    """Only after changes."""
    talk.proxies.says = UP
    talk.all.follow([proxy()], KEY)
    await talk.asked()
    assert talk.proxies.callers == []  # not known yet
    talk.all.brief({UID: Briefing(callers=("10.244.1.5",)), "nobody": Briefing(callers=())})
    await until(lambda: bool(talk.proxies.callers))
    token = token_of(KEY, proxy().pod.id, "node1")
    assert talk.proxies.callers == [(token, "10.244.1.5")]
    talk.all.brief({UID: Briefing(callers=("10.244.1.5",))})
    await talk.asked()
    assert len(talk.proxies.callers) == 1
    talk.all.brief({UID: Briefing(callers=())})
    await until(lambda: len(talk.proxies.callers) == 2)
    assert talk.proxies.callers[-1] == (token,)


async def test_the_allowed_callers_are_repeated_until_confirmed(talk: Talk) -> None:
    """Other updates go on meanwhile."""
    talk.proxies.says = UP
    talk.proxies.deaf = True
    talk.all.follow([proxy()], KEY)
    talk.all.brief({UID: Briefing(callers=("10.244.1.5",))})
    talk.all.brief({UID: Briefing(gone=("10.0.0.1",))})
    await until(lambda: len(talk.proxies.callers) > 2)
    assert talk.proxies.told == [{"gone": ["10.0.0.1"]}]
    assert talk.all.reports[UID].answered


async def test_a_proxy_that_was_started_again_is_told_anew(talk: Talk) -> None:
    talk.proxies.says = UP
    talk.all.follow([proxy()], KEY)
    talk.all.brief({UID: Briefing(callers=("10.244.1.5",))})
    await until(lambda: len(talk.proxies.callers) == 1)
    talk.all.follow([replace(proxy(), restarts=1)], KEY)
    await until(lambda: len(talk.proxies.callers) == 2)
    talk.proxies.failing = 1  # or after a failed answer
    await until(lambda: len(talk.proxies.callers) == 3)


LAYER = PolicyLayer("RosProxy robots/arm", parse_rules("deny publish /camera/*"))


async def test_its_policy_is_told_when_it_changes(talk: Talk) -> None:
    talk.proxies.says = UP
    talk.all.follow([proxy()], KEY)
    await talk.asked()
    assert talk.proxies.policies == []  # not known yet
    token = token_of(KEY, proxy().pod.id, "node1")
    for policy, told in (
        ((), [(token,)]),
        ((LAYER,), [(token,), (token, LAYER)]),
        ((LAYER,), [(token,), (token, LAYER)]),
    ):
        talk.all.brief({UID: Briefing(policy), "nobody": Briefing(())})
        await until(lambda told=told: len(talk.proxies.policies) == len(told))  # type: ignore[misc]
        await talk.asked()
        assert talk.proxies.policies == told


async def test_its_policy_is_told_anew_when_it_was_started_again(talk: Talk) -> None:
    talk.proxies.says = UP
    talk.all.follow([proxy()], KEY)
    talk.all.brief({UID: Briefing((LAYER,))})
    await until(lambda: len(talk.proxies.policies) == 1)
    talk.all.follow([replace(proxy(), restarts=1)], KEY)
    await until(lambda: len(talk.proxies.policies) == 2)
    talk.proxies.failing = 1  # or after a failed answer
    await until(lambda: len(talk.proxies.policies) == 3)


async def test_without_its_policy_a_proxy_gets_no_callers(talk: Talk) -> None:
    """The report has the reason. Other updates and questions go on."""
    talk.proxies.says = UP
    talk.proxies.refuses = PolicyRefused("knows no policies")
    talk.all.follow([proxy()], KEY)
    talk.all.brief({UID: Briefing((LAYER,))})
    talk.all.brief({UID: Briefing(callers=("10.244.1.5",))})
    talk.all.brief({UID: Briefing(gone=("10.0.0.1",))})
    await until(lambda: UID in talk.all.reports)
    assert talk.all.reports[UID].refusal == "knows no policies"
    assert talk.proxies.callers == []
    assert talk.proxies.told == [{"gone": ["10.0.0.1"]}]
    talk.proxies.refuses = None
    await until(lambda: bool(talk.proxies.callers))
    await until(lambda: talk.all.reports[UID].refusal == "")


async def test_it_is_told_now_and_then(talk: Talk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(proxy_sync, "CALLERS_REPEAT_INTERVAL_S", 0.02)
    talk.proxies.says = UP
    talk.all.follow([proxy()], KEY)
    talk.all.brief({UID: Briefing(callers=("10.244.1.5",))})
    await until(lambda: len(talk.proxies.callers) > 2)


async def test_another_key_is_another_token(talk: Talk) -> None:
    talk.proxies.says = UP
    for key in (KEY, b"l" * 32):
        talk.all.follow([proxy()], key)
        talk.all.brief({UID: Briefing(callers=("10.244.1.5",))})
        said = token_of(key, proxy().pod.id, "node1")
        await until(lambda said=said: (said, "10.244.1.5") in talk.proxies.callers)  # type: ignore[misc]


def test_a_former_operators_token_is_in_the_pod() -> None:
    obj = proxy_obj()
    obj["spec"]["containers"][0]["env"] = [{"name": "ROSPROXY_ADMIN_TOKEN", "value": "secret"}]
    parsed = proxy_pod(obj)
    assert parsed is not None
    assert token_for(parsed, KEY) == "secret"


async def listening(talk: Talk) -> None:
    """Wait until the proxy is waited for."""
    await until(lambda: talk.proxies.listening == 1)


async def test_one_that_tells_of_changes_is_not_asked(talk: Talk) -> None:
    talk.proxies.former = False
    talk.proxies.says = UP
    talk.all.follow([proxy()], KEY)
    await listening(talk)
    asked = talk.proxies.asked
    talk.proxies.says = DOWN
    talk.proxies.version = "2"
    talk.proxies.changed.set()
    await until(lambda: not talk.all.reports[UID].master_up)
    await listening(talk)
    assert talk.proxies.asked == asked + 1
    assert talk.proxies.waited[-1][0] == "2"
    assert talk.changes == 2


@pytest.mark.parametrize("status", [403, 503])
async def test_a_proxy_that_refuses_changes_is_asked_for_changes_again(
    talk: Talk, status: int
) -> None:
    talk.proxies.former = False
    talk.proxies.says = UP
    talk.proxies.refusal = status
    talk.all.follow([proxy()], KEY)
    await talk.asked()
    assert talk.all.reports[UID].answered
    talk.proxies.refusal = 0
    await listening(talk)


async def test_a_proxy_of_a_former_release_is_asked_for_changes_once(talk: Talk) -> None:
    talk.proxies.says = UP
    talk.all.follow([proxy()], KEY)
    await talk.asked(5)
    assert len(talk.proxies.waited) == 1


async def test_who_is_waited_for_can_be_told(talk: Talk) -> None:
    talk.proxies.former = False
    talk.proxies.says = UP
    talk.all.follow([proxy()], KEY)
    await listening(talk)
    talk.all.brief({UID: Briefing((LAYER,))})
    talk.all.brief({UID: Briefing(callers=("10.244.1.5",))})
    await until(lambda: len(talk.proxies.callers) == 1)
    talk.all.brief({UID: Briefing(gone=("10.0.0.1",))})
    await until(lambda: talk.proxies.told == [{"gone": ["10.0.0.1"]}])
    await until(lambda: talk.changes == 2)  # another look, whether the nodes are still there
    await listening(talk)
    # Once to begin, once to wait, once after the update, and again later.
    assert [bool(within) for _, within in talk.proxies.waited] == [False, True, False, False]


async def test_an_address_that_stays_is_not_reported_over_and_over(
    talk: Talk, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The operator looks at the result after a while, not at once."""
    monkeypatch.setattr(proxy_sync, "POLL_INTERVAL_S", 3600.0)
    talk.proxies.former = False
    talk.proxies.says = UP
    talk.all.follow([proxy()], KEY)
    await listening(talk)
    talk.all.brief({UID: Briefing(gone=("10.0.0.1",))})
    await until(lambda: len(talk.proxies.waited) == 3)  # a request after the update
    assert talk.changes == 1
    talk.all.brief({UID: Briefing(gone=("10.0.0.1",))})
    await until(lambda: len(talk.proxies.waited) == 4)
    assert talk.changes == 1


@pytest.mark.parametrize("subject", ["policy", "callers"])
async def test_what_is_not_confirmed_is_told_again(talk: Talk, subject: str) -> None:
    talk.proxies.former = False
    talk.proxies.says = UP
    talk.all.follow([proxy()], KEY)
    await listening(talk)
    if subject == "policy":
        talk.proxies.refuses = PolicyRefused("knows no policies")
        talk.all.brief({UID: Briefing((LAYER,))})
        await until(lambda: talk.all.reports[UID].refusal == "knows no policies")
        talk.proxies.refuses = None
        await until(lambda: talk.all.reports[UID].refusal == "")
    else:
        talk.proxies.deaf = True
        talk.all.brief({UID: Briefing(callers=("10.244.1.5",))})
        await until(lambda: len(talk.proxies.callers) > 2)


async def test_another_process_is_told_anew(talk: Talk) -> None:
    talk.proxies.former = False
    talk.proxies.says = {**UP, "instance": "a"}
    talk.all.follow([proxy()], KEY)
    talk.all.brief({UID: Briefing(callers=("10.244.1.5",))})
    await listening(talk)
    talk.proxies.says = {**UP, "instance": "b"}
    talk.proxies.version = "2"
    talk.proxies.changed.set()
    await until(lambda: len(talk.proxies.callers) == 2)


async def test_one_that_falls_silent_is_asked_until_it_answers(talk: Talk) -> None:
    talk.proxies.former = False
    talk.proxies.says = UP
    talk.all.follow([proxy()], KEY)
    await listening(talk)
    talk.proxies.says = None
    talk.proxies.version = "2"
    talk.proxies.changed.set()
    await until(lambda: not talk.all.reports[UID].answered)
    talk.proxies.says = UP
    await until(lambda: talk.all.reports[UID].answered)
    await listening(talk)


async def test_nobody_is_waited_for_who_is_not_there(talk: Talk) -> None:
    talk.proxies.former = False
    talk.proxies.says = UP
    talk.all.follow([proxy()], KEY)
    await listening(talk)
    talk.all.follow([])
    await until(lambda: talk.proxies.listening == 0)


async def test_proxies_whose_masters_hang_keep_nobody_waiting(
    talk: Talk, monkeypatch: pytest.MonkeyPatch
) -> None:
    hung = 0

    async def containers(*_: object) -> dict[str, Any]:
        nonlocal hung
        hung += 1
        await asyncio.Event().wait()
        return {}

    monkeypatch.setattr(talk.proxies, "send_containers", containers)
    talk.proxies.former = False
    talk.proxies.says = UP
    (well, *sick) = [
        replace(proxy(), pod=replace(proxy().pod, uid=f"uid-{number}"))
        for number in range(proxy_sync.MOST_SHORT_CALLS + 2)
    ]
    talk.all.follow([well, *sick], KEY)
    await until(lambda: talk.proxies.listening == len(sick) + 1)
    talk.all.brief({p.pod.uid: Briefing(gone=("10.0.0.1",)) for p in sick})
    await until(lambda: hung == len(sick))
    talk.all.brief({well.pod.uid: Briefing(callers=("10.244.1.5",))})
    await until(lambda: bool(talk.proxies.callers))


async def test_an_operator_that_lost_the_lead_sends_no_more_updates(
    talk: Talk, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also if it loses the lead during an update."""
    leading = True
    asked = asyncio.Event()
    hears = asyncio.Event()

    async def policy(*_: object) -> None:
        asked.set()
        await hears.wait()

    monkeypatch.setattr(talk.proxies, "send_policy", policy)
    talk.proxies.former = False
    talk.proxies.says = UP
    talk.all = ClusterProxySync(talk.tasks, talk.proxies, talk.changed, lambda: leading)
    talk.all.follow([proxy()], KEY)
    await listening(talk)
    talk.all.brief({UID: Briefing((LAYER,))})
    talk.all.brief({UID: Briefing(callers=("10.244.1.5",))})
    talk.all.brief({UID: Briefing(gone=("10.0.0.1",))})
    await asked.wait()
    leading = False
    hears.set()
    await talk.asked()
    assert not talk.proxies.callers
    assert not talk.proxies.told


async def test_a_poller_that_ended_by_a_mistake_is_replaced(
    talk: Talk, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async def mistake(_: HostPort) -> ProxyStatus:
        raise ZeroDivisionError

    with monkeypatch.context() as patch:
        patch.setattr(talk.proxies, "status", mistake)
        talk.all.follow([proxy()], KEY)
        await until(lambda: bool(caplog.records))
    assert "polling" in caplog.text
    talk.proxies.says = UP
    talk.all.follow([proxy()], KEY)
    await talk.asked()


async def test_where_the_live_page_asks_each_proxy_and_with_which_token(talk: Talk) -> None:
    talk.all.follow([proxy()], KEY)
    ((name, way),) = talk.all.admin_endpoints.items()
    assert name == str(proxy().pod.id)
    id_ = proxy().pod.id
    assert logs_command(name) == f"kubectl -n {id_.namespace} logs {id_.name}"
    assert way == (HostPort("10.244.1.7", 11312), token_for(proxy(), KEY))
    talk.all.follow([], KEY)
    assert not talk.all.admin_endpoints
