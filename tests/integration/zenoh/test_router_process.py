"""The router process without the zenoh library: ended connections, changes, and faults."""

import importlib
import io
import json
import os
import queue
import socket
import sys
from collections.abc import Sequence
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest


@pytest.fixture
def process(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The module of the process. The fixture stands in for the zenoh library."""
    name = "rosproxy.zenoh.router_process"
    library = MagicMock(spec=ModuleType)
    library.ZError = RuntimeError
    monkeypatch.setitem(sys.modules, "zenoh", library)
    module = importlib.import_module(name)
    monkeypatch.delitem(sys.modules, name)
    return module


def test_connections_to_an_address_end_and_no_file_stays_open(process: ModuleType) -> None:
    """A robot may move many times, and a process may open a bounded number of files."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = server.getsockname()
        with socket.create_connection(address) as kept, socket.create_connection(address) as ended:
            accepted = [server.accept()[0] for _ in range(2)]
            files = len(os.listdir("/proc/self/fd"))
            remote = [*accepted[1].getpeername()]
            process.end_connections([remote])
            assert len(os.listdir("/proc/self/fd")) == files
            assert ended.recv(1) == b""
            kept.sendall(b"x")
            assert accepted[0].recv(1) == b"x"
            for one in accepted:
                one.close()


class FakeLibrary:
    """Routers that only have an ID and links; ``time`` passes while the process sleeps.

    The hub, which is opened last, links to the routers at the time ``linked_at``.
    """

    def __init__(self, process: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
        self.linked_at = 0.0
        self.time = 0.0
        self.closed: dict[str, float] = {}
        self._opened: list[str] = []
        clock = SimpleNamespace(sleep=self._sleep, monotonic=lambda: self.time)
        monkeypatch.setattr(process, "time", clock)
        monkeypatch.setattr(process, "open_router", self._open)

    def _sleep(self, seconds: float) -> None:
        self.time += seconds

    def _open(self, _: object) -> MagicMock:
        zid = str(len(self._opened))
        self._opened.append(zid)
        session = MagicMock()
        session.info.zid.return_value = zid
        session.info.routers_zid = self._links
        session.close = lambda: self.closed.setdefault(zid, self.time)
        return session

    def _links(self) -> Sequence[str]:
        return self._opened if self.time >= self.linked_at else []


def test_a_router_does_not_end_while_the_hub_dials_it(
    process: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The hub kept the link to the former router, or never dialed again (zenoh 1.7.2)."""
    library = FakeLibrary(process, monkeypatch)
    routers = process.Routers()
    routers.use([{"port": "1"}, {"port": "2"}, {"hub": ""}])
    library.linked_at = 1.0
    routers.use([{"port": "1"}, {"port": "2", "rules": ""}, {"hub": ""}])
    assert [*library.closed] == ["1"]
    assert library.closed["1"] > library.linked_at


def test_a_router_without_a_link_ends_the_process(
    process: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next process begins with the changed configurations."""
    library = FakeLibrary(process, monkeypatch)
    routers = process.Routers()
    routers.use([{"port": "1"}, {"hub": ""}])
    library.linked_at = float("inf")
    with pytest.raises(ValueError, match="the hub has no link to a router for 2 s"):
        routers.use([{"port": "2"}, {"hub": ""}])
    assert not library.closed


def test_the_hub_alone_may_change_without_links(
    process: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    library = FakeLibrary(process, monkeypatch)
    library.linked_at = float("inf")
    routers = process.Routers()
    routers.use([{"port": "1"}, {"hub": ""}])
    routers.use([{"port": "1"}, {"hub": "more"}])
    assert [*library.closed] == ["1"]


def test_a_panic_of_the_library_ends_the_process_with_a_reason(
    process: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Python would wait for the threads of the library, which may hang."""

    class PanicException(BaseException):
        """The base class is the one of pyo3_runtime.PanicException."""

    def fail(_: queue.SimpleQueue[str], __: Any) -> None:
        raise PanicException("PoisonError")

    output = io.StringIO()
    monkeypatch.setattr(process, "run", fail)
    process.serve(queue.SimpleQueue(), output)
    assert json.loads(output.getvalue()) == {"error": "the zenoh library has failed: PoisonError"}
