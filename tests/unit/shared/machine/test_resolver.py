"""Look-ups of host names: bounded, fair, and none leaves anything behind."""

import asyncio
import socket
import threading
from collections import OrderedDict
from collections.abc import AsyncIterator
from typing import Any

import pytest

from rosproxy.shared.machine import resolver
from rosproxy.shared.machine.resolver import (
    MOST_FOR_NODES,
    MOST_FOR_SOURCES,
    MOST_LOOKUPS,
    MOST_PER_SOURCE,
    NODES,
    resolve,
)

FOUND = [(socket.AF_INET, socket.SOCK_STREAM, 6, "", ("192.0.2.7", 0))]


class NameServer:
    """Answers for names that begin with ``good``. Other names hang until the test ends."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.ended = threading.Event()

    def getaddrinfo(self, host: str, *_: Any, **__: Any) -> Any:
        self.asked.append(host)
        if not host.startswith("good"):
            self.ended.wait(30)
            raise OSError("no such name")
        return FOUND


@pytest.fixture
async def server(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[NameServer]:
    made = NameServer()
    monkeypatch.setattr(socket, "getaddrinfo", made.getaddrinfo)
    monkeypatch.setattr(resolver, "RESOLVE_TIMEOUT_S", 0.01)
    monkeypatch.setattr(resolver, "_running", {})
    monkeypatch.setattr(resolver, "_resolved", OrderedDict())
    yield made
    made.ended.set()
    await all_ended()


async def find(host: str, source: str = "") -> list[str]:
    """The addresses of a name that resolves, even on a busy machine."""
    async with asyncio.timeout(30):
        while not (addresses := await resolve(host, source)):
            pass
    return addresses


async def hang(source: str, count: int, name: str = "{source}-{number}") -> None:
    names = [name.format(source=source or "own", number=number) for number in range(count)]
    assert not any(await asyncio.gather(*(resolve(name, source) for name in names)))


async def all_ended() -> None:
    async with asyncio.timeout(30):
        while resolver._running:
            await asyncio.sleep(0.001)


async def test_a_thread_that_can_not_be_started_leaves_no_entry(
    server: NameServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    def start(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", start)
        for number in range(2 * MOST_LOOKUPS):
            assert await resolve(f"good{number}") == []
    assert not resolver._running
    assert await find("good0") == ["192.0.2.7"]


@pytest.mark.parametrize(
    "error", [OSError("no"), UnicodeError("no"), ValueError("no"), MemoryError()]
)
async def test_an_entry_ends_with_its_look_up_however_that_ends(
    server: NameServer, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise error

    monkeypatch.setattr(socket, "getaddrinfo", fail)
    monkeypatch.setattr(threading, "excepthook", lambda _: None)
    assert await resolve("some-name") == []
    await all_ended()


async def test_hanging_names_of_one_caller_hold_up_nobody_else(server: NameServer) -> None:
    await hang("10.0.0.5", 100)
    assert len(server.asked) == MOST_PER_SOURCE
    assert await resolve("good", "10.0.0.5") == []
    assert await find("good", "10.0.0.6") == ["192.0.2.7"]
    assert await find("good-node", NODES) == ["192.0.2.7"]
    assert await find("good-master") == ["192.0.2.7"]


async def test_hanging_names_of_an_ipv6_network_hold_up_no_other_network(
    server: NameServer,
) -> None:
    for number in range(10):
        await hang(f"2001:db8::{number}", 10)
    assert len(server.asked) == MOST_PER_SOURCE * 1.5
    assert await find("good", "2001:db8:0:1::1") == ["192.0.2.7"]


async def test_hanging_names_of_all_others_leave_look_ups_for_the_proxys_own(
    server: NameServer,
) -> None:
    await hang(NODES, 100, "robot.net{number}.test")
    assert len(server.asked) == MOST_FOR_NODES
    for number in range(20):
        await hang(f"10.0.0.{number}", 10)
    assert len(server.asked) == MOST_FOR_NODES + MOST_FOR_SOURCES
    assert await resolve("good", "10.0.1.1") == []
    assert await find("good-master") == ["192.0.2.7"]
    await hang("", 100)
    assert len(server.asked) == MOST_LOOKUPS + 1


@pytest.mark.parametrize(
    "name", ["n{number}.evil.test", "n{number}.a{number}.evil.test", "n{number}"]
)
async def test_hanging_names_of_a_domain_leave_look_ups_for_other_domains(
    server: NameServer, name: str
) -> None:
    await hang(NODES, 100, name)
    assert len(server.asked) == MOST_FOR_NODES // 2
    assert await resolve(name.format(number="good"), NODES) == []
    assert await find("good-robot.lan", NODES) == ["192.0.2.7"]
    assert await find("good-robot.other.test", NODES) == ["192.0.2.7"]


async def test_hanging_names_of_many_domains_leave_look_ups_for_names_that_have_resolved(
    server: NameServer,
) -> None:
    assert await find("good-robot", NODES) == ["192.0.2.7"]
    await hang(NODES, 100, "robot.net{number}.test")
    assert await resolve("good-other", NODES) == []
    for _ in range(100):
        assert await find("good-robot", NODES) == ["192.0.2.7"]


async def test_a_name_that_hangs_after_it_has_resolved_counts_as_a_new_name(
    server: NameServer,
) -> None:
    names = [f"robot.net{number}.test" for number in range(MOST_FOR_NODES)]
    resolver._resolved.update(dict.fromkeys(names))
    assert not any(await asyncio.gather(*(resolve(name, NODES) for name in names)))
    assert not resolver._resolved
    server.ended.set()
    await all_ended()
    server.ended.clear()
    await hang(NODES, MOST_FOR_NODES, "robot.net{number}.test")
    assert await resolve("good-new", NODES) == []


async def test_the_proxy_remembers_a_few_names_that_have_resolved(
    server: NameServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(resolver, "MOST_RESOLVED", 2)
    for name in ("good1", "good2", "good1", "good3"):
        await find(name, NODES)
    assert [*resolver._resolved] == ["good1", "good3"]


async def test_look_ups_are_free_again_when_they_have_ended(server: NameServer) -> None:
    await hang("10.0.0.5", 100)
    server.ended.set()
    await all_ended()
    assert await find("good", "10.0.0.5") == ["192.0.2.7"]


async def test_one_name_is_looked_up_once_for_all_who_wait(server: NameServer) -> None:
    for source in ("10.0.0.5", "10.0.0.6", ""):
        assert await resolve("slow", source) == []
    assert server.asked == ["slow"]


async def test_an_address_is_not_looked_up(server: NameServer) -> None:
    assert await resolve("::ffff:192.0.2.1") == ["192.0.2.1"]
    assert not server.asked
