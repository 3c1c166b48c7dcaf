"""The router process ends connections of the zenoh library, without the library itself."""

import importlib
import os
import socket
import sys
from types import ModuleType

import pytest


@pytest.fixture
def process(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The module of the process. The fixture stands in for the zenoh library."""
    name = "rosproxy.zenoh.router_process"
    monkeypatch.setitem(sys.modules, "zenoh", ModuleType("zenoh"))
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
