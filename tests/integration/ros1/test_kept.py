"""The proxy asks live nodes over a kept connection, and notices the end of this connection."""

import os
import socket
from collections import Counter
from collections.abc import AsyncIterator

import pytest

from examples.demo.fake_http import End, ok, value
from examples.demo.fake_node import FakeNode
from rosproxy.ros1.clients.kept_connections import KeptConnections
from rosproxy.ros1.clients.node_client import NodeClient
from rosproxy.ros1.context import Context
from rosproxy.ros1.registry.node_health import ProbeResult
from rosproxy.runtime import Runtime
from rosproxy.shared.addresses import HostPort
from tests.integration.net import until
from tests.integration.proxy import settings_for

NAME = "/talker"
Kept = KeptConnections[str]


@pytest.fixture
async def kept() -> AsyncIterator[Kept]:
    context = Context(Runtime(settings_for(master_uri="http://127.0.0.1:1")))
    kept = Kept(context.nodes, within=5.0)
    kept.most = 1
    yield kept
    kept.close_all()
    await context.upstream.close()


def ask(kept: Kept, node: FakeNode, now: float = 0.0) -> bool:
    return kept.ask(NAME, HostPort(*node.slave.address), node.pid, now)


async def told(kept: Kept, now: float = 0.0) -> ProbeResult | None:
    """Wait for the result of a question."""
    results = dict[str, ProbeResult | None]()

    def collected() -> bool:
        results.update(kept.collect(now))
        return bool(results)

    await until(collected, "the connection tells something")
    return results[NAME]


def asked(node: FakeNode) -> int:
    return Counter(method for method, _ in node.calls)["getPid"]


async def test_a_node_is_asked_over_and_over_on_one_connection(kept: Kept, node: FakeNode) -> None:
    for _ in range(3):
        assert ask(kept, node)
        assert ask(kept, node)  # and waits for the answer to the first
        assert await told(kept) is ProbeResult.ANSWERED
    assert (asked(node), node.slave.connections) == (3, 1)


async def test_the_end_of_a_node_is_noticed_unasked(kept: Kept, node: FakeNode) -> None:
    ask(kept, node)
    await told(kept)
    assert kept.collect(9.0) == {}
    await node.stop()
    assert await told(kept) is None
    assert kept.collect(9.0) == {}


async def test_a_node_that_is_gone_before_the_connection_is_made(
    kept: Kept, node: FakeNode
) -> None:
    await node.stop()
    assert ask(kept, node)
    assert await told(kept) is None


async def test_a_node_that_hangs_is_silent_after_its_time(kept: Kept, node: FakeNode) -> None:
    ask(kept, node, 10.0)
    await told(kept, 10.0)
    node.hang = True
    ask(kept, node, 20.0)
    await until(lambda: len(node.requests) == 2, "the proxy asks the node")
    assert kept.collect(25.0) == {}
    assert kept.collect(25.1) == {NAME: ProbeResult.SILENT}


async def test_a_node_that_hangs_finds_its_caller_when_it_answers(
    kept: Kept, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = list[socket.socket]()
    monkeypatch.setattr(NodeClient, "close_after_answer", lambda _nodes, sock, _: left.append(sock))
    node.hang = True
    ask(kept, node, 20.0)
    await until(lambda: len(node.requests) == 1, "the proxy asks the node")
    assert kept.collect(25.1) == {NAME: ProbeResult.SILENT}
    assert [sock.getpeername() for sock in left] == [node.slave.address]
    assert kept.collect(25.2) == {}
    left.pop().close()


@pytest.mark.parametrize(
    "answer",
    [
        value([1, "", 4711]),
        value([1, "", "100"]),
        value([-1, "no", 0]),
        ok(b"<methodResponse>"),
        ok(b"x" * 5000),
        ok(b"", "Content-Length: 99999"),
        b"HTTP/1.1 200 OK\r\n\r\n",
        b"HTTP/1.1 500 Internal Server Error\r\nContent-Length: 0\r\n\r\n",
        b"x" * 5000,
        value([1, "", 100]) + b"more",
        End.CLOSE,
        End.RESET,
    ],
    ids=lambda answer: answer.name if isinstance(answer, End) else f"{answer[:20]!r} {len(answer)}",
)
@pytest.mark.parametrize("first", [True, False])
async def test_any_other_answer_ends_the_connection(
    kept: Kept, node: FakeNode, answer: bytes | End, first: bool
) -> None:
    if not first:
        ask(kept, node)
        assert await told(kept) is ProbeResult.ANSWERED
    node.answers["getPid"] = answer
    assert ask(kept, node)
    assert await told(kept) is None
    del node.answers["getPid"]
    assert ask(kept, node)
    assert await told(kept) is ProbeResult.ANSWERED


async def test_another_process_or_place_is_asked_on_a_new_connection(
    kept: Kept, node: FakeNode
) -> None:
    ask(kept, node)
    await told(kept)
    node.pid += 1
    assert ask(kept, node)
    assert await told(kept) is ProbeResult.ANSWERED
    assert node.slave.connections == 2


async def test_there_are_never_too_many_and_those_of_others_are_closed(
    kept: Kept, node: FakeNode
) -> None:
    before = len(os.listdir("/proc/self/fd"))
    ask(kept, node)
    address = HostPort(*node.slave.address)
    assert not kept.ask("/another", address, node.pid, 0.0)
    kept.keep({"/another"})
    assert len(os.listdir("/proc/self/fd")) <= before + 1  # the node's end may still be open
    assert kept.ask("/another", address, node.pid, 0.0)


async def test_the_proxy_keeps_a_connection_to_a_node_that_is_well(make_proxy, node):
    proxy = await make_proxy(probe_interval=0.1)
    await node.publish(proxy.master)
    await until(lambda: asked(node) > 3, "the proxy asks the node")
    before = asked(node)
    connections = node.slave.connections
    await until(lambda: asked(node) > before + 3, "the proxy goes on asking")
    assert node.slave.connections == connections
    node.pid += 1  # as if another process had the address
    await until(lambda: proxy.ros1.context.registry.by_caller[NAME].health.pid == node.pid, "seen")


async def test_a_node_that_ends_every_connection_is_called_and_stays(make_proxy, node):
    proxy = await make_proxy(probe_interval=0.1)
    body = value([1, "", node.pid]).partition(b"\r\n\r\n")[2]
    node.answers["getPid"] = ok(body, "Connection: close")
    await node.publish(proxy.master)
    before = asked(node)
    await until(lambda: asked(node) > before + 4, "the proxy goes on asking")
    assert proxy.app.status()["nodes"][0]["state"] == "ok"
