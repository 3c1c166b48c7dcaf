"""Fixtures: a master, nodes and proxies, all closed at the end."""

import asyncio
import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from typing import Any

import pytest
from aiohttp.http_exceptions import HttpProcessingError
from aiohttp.web import RequestPayloadError

from examples.demo.fake_master import FakeMaster
from examples.demo.fake_node import FakeNode
from tests.clock import PatientLoop
from tests.integration.net import MASTER, NODE
from tests.integration.process import Process
from tests.integration.proxy import BY_THE_WALL, Proxy, settings_for

MakeProxy = Callable[..., Awaitable[Proxy]]
MakeNode = Callable[..., Awaitable[FakeNode]]
LoopFactory = Callable[[], asyncio.AbstractEventLoop]


def pytest_asyncio_loop_factories(item: pytest.Item) -> dict[str, LoopFactory]:
    """A module with BOTH_LOOPS runs in both event loops that users have: uvloop is optional.

    The clock of asyncio's stands still while the process does; that of uvloop can't.
    """
    factories: dict[str, LoopFactory] = {"asyncio": PatientLoop}
    if not getattr(getattr(item, "module", None), "BOTH_LOOPS", False):
        return factories
    try:
        import uvloop
    except ImportError:
        return factories
    return factories | {"uvloop": uvloop.new_event_loop}


@pytest.fixture(autouse=True)
def _no_traceback(caplog: pytest.LogCaptureFixture) -> Iterator[None]:
    """Fail each test that leaves a traceback in the log."""
    yield
    for phase in ("setup", "call", "teardown"):
        for record in caplog.get_records(phase):
            if not is_left_out(record):
                assert not record.exc_info, f"a traceback in the log: {record.getMessage()}"
                assert record.name.startswith("rosproxy") or record.levelno < logging.ERROR, record


def is_left_out(record: logging.LogRecord) -> bool:
    """Whether ``rosproxy run`` leaves such a record out of its log.

    These are faults of clients: a client speaks no HTTP, or is gone before the reply or before the
    end of a refused body. The last two are RuntimeErrors.
    """
    error = record.exc_info[1] if record.exc_info else None
    gone = "the handler is closed", "Connection closed."
    if isinstance(error, RuntimeError) and not any(text in str(error) for text in gone):
        return False
    return record.name == "aiohttp.server" and isinstance(
        error, HttpProcessingError | RequestPayloadError | RuntimeError
    )


@pytest.fixture
def machines_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """Count the hosts of a test as different machines, although all addresses are local."""
    for question in ("is_own", "is_loopback"):
        monkeypatch.setattr(
            f"rosproxy.ros1.stand_ins.outside_nodes.{question}", lambda address: False
        )


@pytest.fixture
async def master() -> AsyncIterator[FakeMaster]:
    """A ROS master outside."""
    made = FakeMaster(MASTER)
    await made.start()
    yield made
    await made.stop()


@pytest.fixture
async def make_node() -> AsyncIterator[MakeNode]:
    """Starts inside nodes."""
    made: list[FakeNode] = []

    async def make(
        name: str = "/talker", address: str = NODE, host: str = "", port: int = 0
    ) -> FakeNode:
        node = FakeNode(name, address, host)
        node.slave.address = address, port
        made.append(node)
        await node.start()
        return node

    yield make
    await asyncio.gather(*(node.stop() for node in made))


@pytest.fixture
async def make_proxy(
    master: FakeMaster, make_node: MakeNode, monkeypatch: pytest.MonkeyPatch
) -> AsyncIterator[MakeProxy]:
    """Starts proxies in this process, by default for ``master``.

    The proxies stop before the nodes: a node cannot close connections that are just being made.
    """
    monkeypatch.setattr("rosproxy.ros1.stack.PROBE_CHECK_INTERVAL_S", 0.03)
    made: list[Proxy] = []

    async def make(**options: Any) -> Proxy:
        by_the_wall = not isinstance(asyncio.get_running_loop(), PatientLoop)
        patience = BY_THE_WALL if by_the_wall else {}
        proxy = Proxy(settings_for(**{"master_uri": master.uri, **patience, **options}))
        made.append(proxy)
        await proxy.start()
        return proxy

    yield make
    await asyncio.gather(*(proxy.stop() for proxy in made))


@pytest.fixture
async def proxy(make_proxy: MakeProxy) -> Proxy:
    """A proxy in this process."""
    return await make_proxy()


@pytest.fixture
async def node(make_node: MakeNode) -> FakeNode:
    """An inside node that has not registered yet."""
    return await make_node()


@pytest.fixture
def start_process(master: FakeMaster) -> Iterator[Callable[..., Process]]:
    """Starts proxies as separate processes, by default for ``master``."""
    made: list[Process] = []

    def start(**options: Any) -> Process:
        made.append(Process({"master_uri": master.uri, **options}))
        return made[-1]

    yield start
    for process in made:
        process.close()
