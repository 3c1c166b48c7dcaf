"""Noticing that the machine's networks change."""

import asyncio
import socket

import pytest

from rosproxy.net import network_changes
from rosproxy.net.network_changes import LOOK_INTERVAL_S, NetworkChanges


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch):
    """The kernel's end of the socket that reports changes."""
    end, told = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    told.setblocking(False)
    monkeypatch.setattr(network_changes, "_route_socket", lambda: told)
    with end, told:
        yield end


async def test_a_change_is_noticed_once(kernel: socket.socket):
    changes = NetworkChanges()
    assert changes.noticed(0.0)  # the networks may have been read before the subscription
    assert not changes.noticed(0.0)
    kernel.send(b"a new address")
    async with asyncio.timeout(5):
        while not changes.noticed(0.0):
            await asyncio.sleep(0)
    assert not changes.noticed(LOOK_INTERVAL_S * 10)
    changes.close()


def test_where_the_kernel_does_not_tell_the_networks_count_as_changed_now_and_then(
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr(network_changes, "_route_socket", lambda: None)
    changes = NetworkChanges()
    assert changes.noticed(100.0)
    assert not changes.noticed(100.0 + LOOK_INTERVAL_S / 2)
    assert changes.noticed(100.0 + LOOK_INTERVAL_S)


async def test_the_kernel_of_this_machine_tells():
    changes = NetworkChanges()
    changes.noticed(0.0)
    assert changes._socket is not None
    changes.close()
