"""Facts for the tests of the doctor: a sound proxy, master and graph, changed by each test."""

from collections.abc import Iterable
from typing import Any

from rosproxy.doctor.facts import (
    Attempt,
    DoctorFacts,
    MasterFacts,
    NodeFacts,
    ReachOutcome,
    SlaveReport,
    SystemState,
)
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.documents.doctor_finding import DoctorFinding, Severity
from rosproxy.shared.documents.requests import read_probe
from rosproxy.shared.documents.status_document import read_status
from tests.unit.status_json import HOST, make_node, make_status

ANSWERED = Attempt(ReachOutcome.ANSWERED)
INSIDE_URI = f"http://{HOST}:45000/"
INSIDE = HostPort("10.0.0.5", 40001)
OUTSIDE_URI = "http://192.168.0.9:35001/"
PROBE = {"port": 45001, "advertised": f"{HOST}:45001", "from_proxy": "ok", "from_master": "ok"}


def make_master(
    reach: ReachOutcome = ReachOutcome.ANSWERED, reason: str = "", **changes: Any
) -> MasterFacts:
    """The real master."""
    defaults = {"uri": "http://robot:11311", "addresses": ("192.168.0.1",), "round_trip": 0.002}
    return MasterFacts(attempt=Attempt(reach, reason), **{**defaults, **changes})


def probes(*outcomes: tuple[str, str]) -> dict[str, Any]:
    """The results of ``POST /probe`` for the lowest and the highest port."""
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


def make_facts(**changes: Any) -> DoctorFacts:
    """A talker inside and a listener outside, both sound."""
    defaults: dict[str, Any] = {
        "admin": "http://127.0.0.1:11312",
        "status": make_status(make_node()),
        "probe": probes(("ok", "ok"), ("ok", "ok")),
        "master": make_master(),
        "advertise_host": HOST,
        "advertised_addresses": ("192.168.0.2",),
        "graph": SystemState({"/chatter": ["/talker"]}, {"/chatter": ["/listener"]}, {}),
        "nodes": by_name(talker(), listener()),
    }
    given = {**defaults, **changes}
    if given["status"] is not None:
        given["status"] = read_status(given["status"])
    if given["probe"] is not None:
        given["probe"] = read_probe(given["probe"])
    return DoctorFacts(**given)


def without_proxy(**changes: Any) -> DoctorFacts:
    """The same where the admin endpoint can't be asked."""
    return make_facts(
        **{"status": None, "probe": None, "admin_error": "no rosproxy answers", **changes}
    )


def by_name(*nodes: NodeFacts) -> dict[str, NodeFacts]:
    """Nodes by name."""
    return {node.name: node for node in nodes}


def talker(**changes: Any) -> NodeFacts:
    """The node behind the proxy."""
    report = SlaveReport(
        {"/chatter": "std_msgs/String"}, {}, frozenset({("o", "/chatter", "/listener")})
    )
    defaults = {"name": "/talker", "uri": INSIDE_URI, "inside": INSIDE, "report": report}
    return NodeFacts(**{**defaults, **changes})


def listener(**changes: Any) -> NodeFacts:
    """The node outside."""
    report = SlaveReport({}, {"/chatter": "std_msgs/String"})
    defaults = {"name": "/listener", "uri": OUTSIDE_URI, "addresses": ("192.168.0.9",)}
    return NodeFacts(**{**defaults, "attempt": ANSWERED, "report": report, **changes})


def only(findings: Iterable[DoctorFinding], severity: Severity = Severity.WARNING) -> DoctorFinding:
    """The only finding of at least this severity."""
    (finding,) = [f for f in findings if f.severity >= severity]
    return finding
