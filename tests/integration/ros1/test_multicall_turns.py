"""Long work of one caller is done in turns, and other callers are served in between."""

import asyncio
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

from rosproxy.access.access_policy import AccessPolicy
from rosproxy.net.http_client import LONG_BODY_BYTES
from rosproxy.ros1.api.slave import SlaveApi
from rosproxy.ros1.clients import master_client
from rosproxy.ros1.protocol.xmlrpc.document import dump_reply
from rosproxy.ros1.protocol.xmlrpc.passing import PIECE_BYTES, MulticallWatch
from rosproxy.ros1.rewriting.addressing import Addressing, Caller
from rosproxy.ros1.stand_ins.stand_in_ports import URIS_PER_TURN
from rosproxy.ros1.upkeep.decisions import registration as decisions
from rosproxy.shared.addresses import HostPort
from tests.integration.net import NODE, PROXY, exchange, post, rpc, until, xml

CALLS = 100


class Rounds:
    """Counts the rounds of the event loop, and notes the rounds with a call of a method."""

    def __init__(self) -> None:
        self.noted = set[int]()
        self._current = 0
        self._next: asyncio.Handle
        self._turn()

    def noting(self, method: Callable[..., Any]) -> Callable[..., Any]:
        """Wrap a method to note each call."""

        def called(*values: Any) -> Any:
            self.noted.add(self._current)
            return method(*values)

        return called

    def end(self) -> None:
        """Count no more."""
        self._next.cancel()

    def _turn(self) -> None:
        self._current += 1
        self._next = asyncio.get_running_loop().call_soon(self._turn)


@pytest.fixture
async def rounds() -> AsyncIterator[Rounds]:
    made = Rounds()
    yield made
    made.end()


def several(method: str, *params: Any) -> list[dict[str, Any]]:
    return [{"methodName": method, "params": list(params)}] * CALLS


async def test_calls_of_inside(make_proxy, node, rounds, monkeypatch):
    """With the longest rules, judging 20 calls at once blocks other callers for 0.6 s."""
    proxy = await make_proxy(policy="deny get-param /secret/*")
    await node.publish(proxy.master)
    monkeypatch.setattr(AccessPolicy, "judge", rounds.noting(AccessPolicy.judge))
    results = await rpc(proxy.master, "system.multicall", several("getParam", node.name, "/p"))
    assert len(results) == CALLS
    assert len(rounds.noted) >= CALLS


async def test_registrations(make_proxy, node, rounds, monkeypatch):
    proxy = await make_proxy(policy="deny publish /secret/*")
    await node.publish(proxy.master)
    calls = several("registerPublisher", node.name, "/t", "x/Y", node.uri)
    monkeypatch.setattr(AccessPolicy, "judge", rounds.noting(AccessPolicy.judge))
    results = await rpc(proxy.master, "system.multicall", calls, source=NODE)
    assert len(results) == CALLS
    assert len(rounds.noted) >= CALLS


async def test_calls_of_outside_that_are_refused(proxy, node, rounds, monkeypatch):
    await node.publish(proxy.master)
    monkeypatch.setattr(SlaveApi, "_refuse", rounds.noting(SlaveApi._refuse))
    calls = several("paramUpdate", "/master", "/p", 1)
    results = await rpc(proxy.lease(node), "system.multicall", calls)
    assert [status for ((status, *_),) in results] == [-1] * CALLS
    assert len(rounds.noted) >= CALLS


async def test_a_long_multicall_that_passes_unread(proxy, node, rounds, monkeypatch):
    """To watch 64 KiB full of tags takes about 60 ms."""
    await node.publish(proxy.master)
    monkeypatch.setattr(MulticallWatch, "see", rounds.noting(MulticallWatch.see))
    whole = xml("system.multicall", several("getPid", "/n") * 50)
    body = whole.replace(b"<params>", b"<!-- not for regular expressions --><params>", 1)
    reply = await exchange(proxy.master, post(body), NODE)
    assert len(reply.value) == 50 * CALLS
    assert len(rounds.noted) >= len(body) // PIECE_BYTES


async def test_the_uris_of_a_topic_with_thousands_of_publishers(make_proxy, rounds, monkeypatch):
    """Reading 3,000 URIs at once took 0.15 s."""
    proxy = await make_proxy(direction="both")
    target = rounds.noting(Addressing.stand_in_target)
    monkeypatch.setattr(Addressing, "stand_in_target", target)
    uris = [f"http://elsewhere.{NODE}/{number}" for number in range(3000)]
    await proxy.ros1.stand_ins.listen_for(uris, Caller(NODE, PROXY))
    assert len(rounds.noted) >= len(uris) // URIS_PER_TURN


async def test_long_replies_of_several_nodes(make_proxy, rounds, monkeypatch):
    """Lists of 4 MB with entities, of 24 nodes that changed their pids, took 10 s at once."""
    proxy = await make_proxy()
    nodes = proxy.ros1.context.upstream

    async def post_to_node(*_: Any, **__: Any) -> bytes:
        return dump_reply([1, "", [["/t", "x" * LONG_BODY_BYTES]]])

    monkeypatch.setattr(nodes, "post_to_node", post_to_node)
    monkeypatch.setattr(master_client, "read_value", rounds.noting(master_client.read_value))
    slave = HostPort(NODE, 40000)
    calls = [nodes.call_node(slave, 1.0, "getPublications") for _ in range(3)]
    assert len(await asyncio.gather(*calls)) == 3
    assert len(rounds.noted) >= 3


async def test_what_the_master_may_have_lost(make_proxy, master, make_node, rounds, monkeypatch):
    """To compare 250,000 registrations of 25 nodes with the master at once took 0.9 s."""
    proxy = await make_proxy(master_interval=60.0)
    for number in range(3):
        node = await make_node(f"/n{number}")
        await node.publish(proxy.master)
    await until(lambda: all(e.answers for e in proxy.ros1.context.registry), "all nodes answer")
    compare = rounds.noting(decisions.lost_registrations)
    monkeypatch.setattr(decisions, "lost_registrations", compare)
    master.tables["publishers"].clear()
    await proxy.ros1.registrar.register_lost()
    assert len(rounds.noted) >= 3
    assert len(master.tables["publishers"]["/chatter"]) == 3
