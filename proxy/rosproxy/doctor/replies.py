"""Replies of the master and of nodes, made into facts; what does not fit is dropped."""

from collections.abc import Iterator
from typing import Any

from rosproxy.doctor.facts import SlaveReport, SystemState
from rosproxy.net.addresses import HostPort


def system_state(state: Any) -> SystemState:
    """The reply to ``getSystemState``: publishers, subscribers, services."""
    tables = [
        {name: [str(node) for node in nodes] for name, nodes in _pairs(rows, list)}
        for rows in _items(state)[:3]
    ]
    return SystemState(*tables)


def slave_report(publications: Any, subscriptions: Any, bus: Any) -> SlaveReport:
    """The replies to ``getPublications``, ``getSubscriptions`` and ``getBusInfo``.

    A row of the last is ``[id, peer, direction, transport, topic, connected, ...]``.
    """
    rows = [row for row in _items(bus) if isinstance(row, list) and len(row) > 5 and row[5]]
    return SlaveReport(
        dict(_pairs(publications, str)),
        dict(_pairs(subscriptions, str)),
        frozenset((str(row[2]), str(row[4]), str(row[1])) for row in rows),
    )


def data_port(answer: Any) -> HostPort | None:
    """The reply to ``requestTopic``: where to connect to, None if that is no TCPROS address."""
    match answer:
        case ["TCPROS", str(host), int(port)] if 0 < port < 65536:
            return HostPort(host, port)
    return None


def _pairs(rows: Any, kind: type) -> Iterator[tuple[str, Any]]:
    for row in _items(rows):
        match row:
            case [str(name), value] if isinstance(value, kind):
                yield name, value


def _items(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []
