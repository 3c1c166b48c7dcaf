"""The probe of the range: results that the master's end does not change."""

import asyncio
import socket
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Sequence
from contextlib import asynccontextmanager
from types import SimpleNamespace
from typing import Any

import pytest

from rosproxy.ros1 import range_probe
from rosproxy.ros1.clients.master_client import Unreachable
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortMap, PortRange

Greet = Callable[[socket.socket, str], Awaitable[None]]
# Nothing listens at port 1, so the proxy's own attempt is refused.
PORT = 1


class OnePort:
    """A range with a single port."""

    greet: Greet

    @asynccontextmanager
    async def lend(self, _: Iterable[int], greet: Greet, __: bool) -> AsyncIterator[int]:
        self.greet = greet
        yield PORT

    def is_lent(self, _: int) -> bool:
        return True


class EndingMaster:
    """A master that ends before the calls that clean up. ``reaches``: it reaches the port."""

    def __init__(self, leases: OnePort, reaches: bool) -> None:
        self._leases = leases
        self._reaches = reaches

    def reach(self, target: HostPort) -> HostPort:
        return target

    async def multicall(self, calls: Sequence[tuple[str, list[Any]]]) -> list[Any]:
        if calls[0][0] != "subscribeParam":
            raise Unreachable("the master has ended")
        if self._reaches:
            ours, theirs = socket.socketpair()
            ours.setblocking(False)
            with theirs:
                theirs.sendall(calls[0][1][0].encode())
                await self._leases.greet(ours, "192.0.2.1")
        return [0, 0]


@pytest.mark.parametrize(("reaches", "outcome"), [(True, "ok"), (False, "missed")])
async def test_a_result_counts_even_if_the_master_ends_before_the_clean_up(
    monkeypatch: pytest.MonkeyPatch, reaches: bool, outcome: str
) -> None:
    monkeypatch.setattr(range_probe, "MASTER_TIMEOUT_S", 0.05)
    leases: Any = OnePort()
    ports = PortRange(PORT, PORT)
    context: Any = SimpleNamespace(
        registry=SimpleNamespace(pool=SimpleNamespace(free=1)),
        settings=SimpleNamespace(ports=PortMap(ports, ports)),
        addressing=SimpleNamespace(outside=lambda port: HostPort("127.0.0.1", port)),
        upstream=EndingMaster(leases, reaches),
    )
    async with asyncio.timeout(10):
        (probe,) = await range_probe.probe_range(context, leases)
    assert (probe.from_proxy, probe.from_master) == ("refused", outcome)
