"""Facts for the tests of the doctor: a sound proxy, master and graph, changed by each test."""

from collections.abc import Iterable
from typing import Any

from rosproxy.doctor.facts import Attempt, Facts, Graph, Master, Node, Reach, Words
from rosproxy.doctor.findings import Finding, Severity
from tests.unit.status_json import HOST, make_node, make_status

ANSWERED = Attempt(Reach.ANSWERED)
INSIDE_URI = f"http://{HOST}:45000/10.0.0.5:40001/"
OUTSIDE_URI = "http://192.168.0.9:35001/"
PROBE = {"port": 45001, "advertised": f"{HOST}:45001", "from_proxy": "ok", "from_master": "ok"}


def make_master(reach: Reach = Reach.ANSWERED, reason: str = "", **changes: Any) -> Master:
    """The real master."""
    known = {"uri": "http://robot:11311", "addresses": ("192.168.0.1",), "round_trip": 0.002}
    return Master(attempt=Attempt(reach, reason), **{**known, **changes})


def probes(*outcomes: tuple[str, str]) -> dict[str, Any]:
    """What ``POST /probe`` returns for the lowest, the highest port."""
    ports = (45001, 45099)
    return {
        "probes": [
            {
                "port": port,
                "advertised": f"{HOST}:{port}",
                "from_proxy": mine,
                "from_master": masters,
            }
            for port, (mine, masters) in zip(ports, outcomes, strict=False)
        ]
    }


def make_facts(**changes: Any) -> Facts:
    """A talker inside and a listener outside, both sound."""
    known: dict[str, Any] = {
        "admin": "http://127.0.0.1:11312",
        "status": make_status(make_node()),
        "probe": probes(("ok", "ok"), ("ok", "ok")),
        "master": make_master(),
        "advertise_host": HOST,
        "advertised_addresses": ("192.168.0.2",),
        "graph": Graph({"/chatter": ["/talker"]}, {"/chatter": ["/listener"]}, {}),
        "nodes": by_name(talker(), listener()),
    }
    return Facts(**{**known, **changes})


def without_proxy(**changes: Any) -> Facts:
    """The same where the admin endpoint can't be asked."""
    return make_facts(
        **{"status": None, "probe": None, "admin_error": "no rosproxy answers", **changes}
    )


def by_name(*nodes: Node) -> dict[str, Node]:
    """Nodes by their names."""
    return {node.name: node for node in nodes}


def talker(**changes: Any) -> Node:
    """The node behind the proxy."""
    words = Words({"/chatter": "std_msgs/String"}, {}, frozenset({("o", "/chatter", "/listener")}))
    return Node(**{"name": "/talker", "uri": INSIDE_URI, "words": words, **changes})


def listener(**changes: Any) -> Node:
    """The node outside."""
    words = Words({}, {"/chatter": "std_msgs/String"})
    known = {"name": "/listener", "uri": OUTSIDE_URI, "addresses": ("192.168.0.9",)}
    return Node(**{**known, "attempt": ANSWERED, "words": words, **changes})


def only(findings: Iterable[Finding], severity: Severity = Severity.WARNING) -> Finding:
    """The one finding that is at least so bad."""
    (found,) = [f for f in findings if f.severity >= severity]
    return found
