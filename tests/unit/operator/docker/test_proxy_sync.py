"""Updates to proxies: policy, allowed callers, and everything else."""

import asyncio
from collections.abc import AsyncIterator, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import pytest

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.documents.status_document import (
    DomainStatus,
    LocatorStatus,
    ParticipantStatus,
    ProxyStatus,
)
from rosproxy.shared.policy.layers import PolicyLayer
from rosproxy.shared.policy.rules import parse_rules
from rosproxy.shared.ports import PortRange
from rosproxy.shared.tasks import Tasks
from rosproxy_operator.common.policy import administrators_policy
from rosproxy_operator.common.proxy_client import PolicyRefused, ProxyClient, ProxyError
from rosproxy_operator.docker import proxy_sync
from rosproxy_operator.docker.planner.labels.members import LabelReading
from rosproxy_operator.docker.planner.model import Attachment, Member
from rosproxy_operator.docker.proxy_sync import DockerProxySync, silent_proxy_problem
from rosproxy_operator.docker.snapshot import DockerSnapshot, ProxyAccess
from rosproxy_operator.proxy_spec.place import ZENOH
from tests.unit.operator.docker.builders import PLACE, RANGE, SETTINGS, both, container, observed

WHERE = HostPort("172.30.0.2", 11312)
PREFIX = "01.0f.45.d1.3c.00.a7.12.00.00.00.00"
FIRST = ProxyAccess(WHERE, "token", "run 1")
SECOND = ProxyAccess(WHERE, "token", "run 2")


class Proxies(ProxyClient):
    """A proxy that notes updates, and answers only with ``known_status``.

    ``calls`` are all updates in order: addresses, or names of layers.
    """

    def __init__(self) -> None:
        super().__init__()
        self.told: list[list[str]] = []
        self.former: Mapping[str, Sequence[int]] | None = None
        self.known_status: ProxyStatus | None = None
        self.calls: list[list[str]] = []
        self.refuses: ProxyError | None = None
        self.heard = asyncio.Event()
        self.errors: list[ProxyError] = []
        self.unreadable: ProxyError | None = None
        self.bodies: list[Mapping[str, Any]] = []

    async def status(self, admin: HostPort) -> Any:
        if self.unreadable:
            raise self.unreadable
        if self.known_status is None:
            await asyncio.Event().wait()
        return self.known_status

    async def send_containers(self, admin: HostPort, token: str, body: Mapping[str, Any]) -> Any:
        self.bodies.append(body)
        return {}

    async def send_policy(self, admin: HostPort, token: str, layers: Sequence[PolicyLayer]) -> None:
        assert (admin, token) == (WHERE, "token")
        self.calls.append([layer.name for layer in layers])
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
        assert (admin, token) == (WHERE, "token")
        if self.errors:
            raise self.errors.pop()
        self.former = former
        self.calls.append(sorted(addresses))
        self.told.append(sorted(addresses))
        self.heard.set()

    async def next(self) -> list[str]:
        await asyncio.wait_for(self.heard.wait(), 30)
        self.heard.clear()
        return self.told[-1]


@pytest.fixture
async def tasks() -> AsyncIterator[Tasks]:
    tasks = Tasks()
    yield tasks
    await tasks.cancel()


def look(
    *addresses: str, access: ProxyAccess = FIRST, policy: str = "", ports: PortRange = RANGE
) -> tuple[DockerSnapshot, list[Member]]:
    """Selected containers at these addresses, on the proxy's network.

    ``policy`` is the label of each container.
    """
    nodes = [
        container(f"node{number}", networks=[Attachment("app", address)])
        for number, address in enumerate(addresses)
    ]
    own = both(ports=ports)
    box = own["sandboxes"][0]
    home = Attachment("app", "172.18.0.2")
    own["sandboxes"] = [replace(box, container=replace(box.container, attachments=(home,)))]
    state = observed(*nodes, **own)
    name = state.proxies[0].container.name
    seen = DockerSnapshot(state, LabelReading(), {name: access}, at_host=True)
    return seen, [Member(node, PLACE, policy=parse_rules(policy)) for node in nodes]


async def test_who_may_use_it_is_told_though_the_proxy_is_busy_with_all_else(tasks: Tasks) -> None:
    proxies = Proxies()
    sync = DockerProxySync(tasks, proxies, SETTINGS, lambda: None)
    sync.update(*look("172.18.0.5"))
    assert await proxies.next() == ["172.18.0.5"]
    sync.update(*look("172.18.0.5", "172.18.0.6"))
    assert await proxies.next() == ["172.18.0.5", "172.18.0.6"]
    sync.update(*look())
    assert await proxies.next() == []


async def test_it_is_told_anew_at_each_look_and_to_each_run_of_the_proxy(tasks: Tasks) -> None:
    proxies = Proxies()
    sync = DockerProxySync(tasks, proxies, SETTINGS, lambda: None)
    for access in (FIRST, FIRST, SECOND):
        sync.update(*look("172.18.0.5", access=access))
        assert await proxies.next() == ["172.18.0.5"]


async def test_a_proxy_for_rmw_zenoh_is_not_told_who_may_use_it(tasks: Tasks) -> None:
    """Such a proxy does not know the call."""
    proxies = Proxies()
    proxies.known_status = ProxyStatus()
    sync = DockerProxySync(tasks, proxies, SETTINGS, lambda: None)
    seen, members = look("172.18.0.5")
    (proxy,) = seen.state.proxies
    seen = replace(seen, state=replace(seen.state, proxies=(replace(proxy, place=ZENOH),)))
    sync.update(seen, [replace(member, place=ZENOH) for member in members])
    while not sync.answers(proxy.container.name):
        await asyncio.sleep(0)
    assert (proxies.calls, proxies.told, proxies.bodies) == ([[]], [], [])


@pytest.mark.parametrize(
    ("ports", "told"),
    [(RANGE, {}), (PortRange(11400, 11500), {}), (PortRange(11402, 11440), {PREFIX: (11401,)})],
)
async def test_a_proxy_that_had_to_leave_its_ports_is_told_who_had_some(
    ports: PortRange, told: Mapping[str, Sequence[int]], tasks: Tasks
) -> None:
    proxies = Proxies()
    sync = DockerProxySync(tasks, proxies, SETTINGS, lambda: None)
    participant = ParticipantStatus(
        guid_prefix=PREFIX, address="172.18.0.5", leases=(LocatorStatus(port=11401),)
    )
    proxies.known_status = ProxyStatus(domains=(DomainStatus(inside=(participant,)),))
    seen, members = look("172.18.0.5")
    sync.update(seen, members)
    await proxies.next()
    while not sync.answers(seen.state.proxies[0].container.name):
        await asyncio.sleep(0)
    proxies.known_status = None

    sync.update(*look("172.18.0.5", access=SECOND, ports=ports))

    await proxies.next()
    assert proxies.former == told


async def test_a_proxy_that_says_too_much_is_told_what_is_new_by_what_it_said_last(
    tasks: Tasks,
) -> None:
    proxies = Proxies()
    sync = DockerProxySync(tasks, proxies, SETTINGS, lambda: None)
    participant = ParticipantStatus(
        guid_prefix=PREFIX, address="172.18.0.5", leases=(LocatorStatus(port=11401),)
    )
    proxies.known_status = ProxyStatus(domains=(DomainStatus(inside=(participant,)),))
    seen, members = look("172.18.0.5")
    name = seen.state.proxies[0].container.name
    sync.update(seen, members)
    await proxies.next()
    while not sync.answers(name):
        await asyncio.sleep(0)

    proxies.unreadable = ProxyError("answers GET /status with more than", is_unreadable=True)
    proxies.bodies.clear()
    sync.update(*look("172.18.0.5", "172.18.0.6"))
    await proxies.next()
    while sync.answers(name):
        await asyncio.sleep(0)

    updater, _ = sync._running[name]
    assert updater.leases == {PREFIX: (11401,)}
    assert updater.error is proxies.unreadable
    arrived = {row["address"] for body in proxies.bodies for row in body.get("arrived", ())}
    assert "172.18.0.6" in arrived


async def test_what_was_not_heard_is_told_again(
    tasks: Tasks, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(proxy_sync, "RETRY_PAUSES_S", (0.0, 0.0))
    proxies = Proxies()
    proxies.errors = [ProxyError("answers HTTP 400: selected: unknown field")] * 5
    sync = DockerProxySync(tasks, proxies, SETTINGS, lambda: None)
    sync.update(*look("172.18.0.5"))
    assert await proxies.next() == ["172.18.0.5"]
    (told,) = caplog.messages
    assert "does not know which addresses may use it: answers HTTP 400" in told


RULE = "deny publish /camera/*"
COMMON = administrators_policy([parse_rules(RULE)], "enforce")


async def test_a_policy_is_told_before_who_may_use_it_and_only_when_it_has_changed(
    tasks: Tasks,
) -> None:
    proxies = Proxies()
    settings = replace(SETTINGS, policy=COMMON)
    sync = DockerProxySync(tasks, proxies, settings, lambda: None)
    label = "label of container node0"
    addresses = ["172.18.0.5"]
    for policy, access, calls in (
        ("", FIRST, [["administrator"], addresses]),
        ("", FIRST, [addresses]),
        (RULE, FIRST, [["administrator", label], addresses]),
        (RULE, FIRST, [addresses]),
        (RULE, SECOND, [["administrator", label], addresses]),  # the proxy was restarted
    ):
        proxies.calls.clear()
        sync.update(*look(*addresses, access=access, policy=policy))
        await proxies.next()
        assert proxies.calls == calls


async def test_without_its_policy_nobody_new_is_let_in(
    tasks: Tasks, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(proxy_sync, "RETRY_PAUSES_S", (0.0, 0.0))
    proxies = Proxies()
    proxies.refuses = PolicyRefused("knows no policies")
    sync = DockerProxySync(tasks, proxies, SETTINGS, lambda: None)
    seen, members = look("172.18.0.5", policy=RULE)
    sync.update(seen, members)
    while len(proxies.calls) < 3:
        await asyncio.sleep(0)
    assert proxies.told == []
    proxies.refuses = None
    assert await proxies.next() == ["172.18.0.5"]
    problem = silent_proxy_problem("p", PolicyRefused("knows no policies"), seen, "0-rosproxy")
    assert (problem.subject, problem.text, problem.fatal) == (
        "proxy p",
        "knows no policies",
        True,
    )


async def test_what_ends_the_task_of_a_proxy_ends_it_until_the_next_look(
    tasks: Tasks, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next look must start a new task, or the proxy gets no more updates."""
    proxies = Proxies()
    proxies.known_status = ProxyStatus()
    sync = DockerProxySync(tasks, proxies, SETTINGS, lambda: None)
    with monkeypatch.context() as broken:
        broken.setattr(proxy_sync, "inside_addresses", lambda _: 1 / 0)
        sync.update(*look("172.18.0.5"))
        _, task = next(iter(sync._running.values()))
        await asyncio.wait([task])
    proxies.heard.clear()
    sync.update(*look("172.18.0.6"))
    assert await proxies.next() == ["172.18.0.6"]
