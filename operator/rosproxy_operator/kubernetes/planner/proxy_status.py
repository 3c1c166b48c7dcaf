"""What proxies answer, read. It is made of what ROS nodes say of themselves: trust no size."""

from typing import Any

from rosproxy.net.addresses import parse_host_port, plain_address
from rosproxy.telemetry.text import clean
from rosproxy_operator.kubernetes.planner.model import Json, ProxyReport
from rosproxy_operator.kubernetes.planner.values import number, part, parts, word

LONGEST = 300
"""Characters of a problem or an error."""
_GIVEN_UP = "cleaned"
RECENT = 300.0
"""Seconds that a problem counts: a proxy tells the last ones, however old they are."""


def answer(status: Any) -> ProxyReport:
    """What a proxy's ``/status`` says (``rosproxy.admin.status.describe``). Never raises.

    Nodes that it has given up already, and unregistered, are not among its nodes.
    """
    master = part(status, "master")
    up = master.get("up") is True
    nodes = tuple(one for one in parts(status, "nodes") if one.get("state") != _GIVEN_UP)
    return ProxyReport(
        answered=True,
        master_up=up,
        error="" if up else _short(word(master, "error") or "not asked yet"),
        nodes=_nodes(nodes),
        topics=frozenset(topic for node in nodes for topic in _topics(node)),
        used=number(part(status, "ports"), "used"),
        problems=tuple(_problem(one) for one in parts(status, "problems") if _recent(one)),
    )


def no_answer(error: str) -> ProxyReport:
    """What is known of a proxy that does not answer."""
    return ProxyReport(answered=False, error=_short(error))


def _nodes(nodes: tuple[Json, ...]) -> dict[str, tuple[str, ...]]:
    found: dict[str, list[str]] = {}
    for node in nodes:
        where = parse_host_port(word(node, "address"))
        if where is not None:
            found.setdefault(plain_address(where.host), []).extend(_texts(node, "nodes"))
    return {address: tuple(sorted(set(names))) for address, names in found.items()}


def _topics(node: Json) -> tuple[str, ...]:
    return _texts(node, "publishes") + _texts(node, "subscribes")


def _texts(node: Json, key: str) -> tuple[str, ...]:
    found = node.get(key)
    return tuple(one for one in found if isinstance(one, str)) if isinstance(found, list) else ()


def _recent(problem: Json) -> bool:
    age = problem.get("age")
    return isinstance(age, int | float) and age <= RECENT


def _problem(problem: Json) -> str:
    return _short(f"{word(problem, 'subject')}: {word(problem, 'text')}")


def _short(text: str) -> str:
    bare = clean(text)
    return bare if len(bare) <= LONGEST else f"{bare[: LONGEST - 1]}…"
