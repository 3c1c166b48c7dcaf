"""The connections of a port: counted and forgotten without looking at all for each new one."""

from typing import Any

from rosproxy.ros1.servers.xmlrpc_server import PortConnections


class Handler:
    """Stands in for aiohttp's; ``looks`` counts how often anybody looked at any of them."""

    looks = 0

    def __init__(self) -> None:
        self.open = True

    @property
    def transport(self) -> object | None:
        Handler.looks += 1
        return self if self.open else None


def test_only_open_ones_are_alive() -> None:
    connections, handlers = PortConnections(), [Handler() for _ in range(100)]
    for number, handler in enumerate(handlers):
        connections.add(as_aiohttp_s(handler))
        handler.open = number % 3 == 0
    assert [id(one) for one in connections.alive()] == [id(one) for one in handlers if one.open]


def test_those_that_have_ended_are_forgotten() -> None:
    connections = PortConnections()
    for _ in range(1000):
        handler = Handler()
        connections.add(as_aiohttp_s(handler))
        handler.open = False
    assert connections.alive() == []
    assert len(connections._known) < 50


def test_many_open_ones_are_not_all_looked_at_for_each_new_one() -> None:
    connections, Handler.looks = PortConnections(), 0
    for _ in range(1000):
        connections.add(as_aiohttp_s(Handler()))
    assert Handler.looks < 4000
    assert len(connections.alive()) == 1000


def as_aiohttp_s(handler: Handler) -> Any:
    return handler
