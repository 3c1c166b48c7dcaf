"""Fixes are pasted into a shell: no name that a node has chosen is a command there."""

from collections.abc import Iterator
from itertools import product

import pytest

from rosproxy.doctor.facts import (
    Attempt,
    DoctorFacts,
    NodeFacts,
    ReachOutcome,
    SlaveReport,
    SystemState,
)
from rosproxy.doctor.rules import diagnose, diagnose_running
from rosproxy.ros1.registry.endpoint import STATES
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.output.text import LONGEST_QUOTED, quoted
from tests.unit.doctor.cases import by_name, make_facts, make_master, probes
from tests.unit.status_json import HOST, make_node, make_status

COMMAND = ";touch pwned"
NODE, OTHER, TOPIC, SERVICE = (f"/{name}{COMMAND}$(x)`y`'\"" for name in "nots")
URIS = (f"http://{HOST}:45000/", "http://10.0.0.9:4001/", f"http://x{COMMAND}:1/", "http://a.b:1/")
REPORTS = (
    None,
    SlaveReport(publishes={TOPIC: "a/A"}, subscribes={TOPIC: "a/A"}),
    SlaveReport(publishes={TOPIC: f"b/B{COMMAND}"}, subscribes={TOPIC: "a/A"}),
    SlaveReport(),
)


def facts_of_all_kinds() -> Iterator[DoctorFacts]:
    for state, reach, uris, report, names, direction in product(
        STATES,
        ReachOutcome,
        product(URIS, URIS),
        REPORTS,
        ((), (TOPIC,), (SERVICE,), (NODE, OTHER), (f"/unknown{COMMAND}", f"{TOPIC}x")),
        ("out", "both"),
    ):
        attempt = Attempt(reach, COMMAND)
        status = make_status(
            make_node(NODE, state=state, publishes=[TOPIC], address=f"10.0.0.5{COMMAND}:40001")
        )
        status["settings"]["direction"] = direction
        yield make_facts(
            status=status,
            names=names,
            graph=SystemState(
                {TOPIC: [NODE]}, {TOPIC: [OTHER], f"/a{TOPIC}": [NODE]}, {SERVICE: [NODE]}
            ),
            nodes=by_name(
                NodeFacts(NODE, uris[0], HostPort("10.0.0.5", 40001), (), attempt, report),
                NodeFacts(OTHER, uris[1], None, (), Attempt(ReachOutcome.ANSWERED), REPORTS[1]),
            ),
            service_uris={SERVICE: "rosrpc://10.0.0.9:4002"},
            services={SERVICE: attempt},
            data_ports={(NODE, TOPIC): (f"x{COMMAND}:4003", attempt)},
        )


def bare(fix: str) -> str:
    """A fix without the words that are quoted."""
    for name in (NODE, OTHER, TOPIC, SERVICE, f"/a{TOPIC}", *URIS, f"10.0.0.5{COMMAND}"):
        fix = fix.replace(quoted(name), "")
    return fix


def test_no_rule_has_a_name_as_a_command() -> None:
    """``rostopic info /scan;reboot`` was the fix for a topic of that name."""
    fixes = {f.fix for facts in facts_of_all_kinds() for f in diagnose(facts)}
    assert {fix for fix in fixes if "pwned" in bare(fix)} == set()
    assert sum("pwned" in fix for fix in fixes) > 10


@pytest.mark.parametrize("reach", ReachOutcome)
def test_neither_has_the_masters_host(reach: ReachOutcome) -> None:
    uri = f"http://robot{COMMAND}:11311"
    master = make_master(reach, uri=uri)
    facts = make_facts(
        master=master, advertise_host=f"robot{COMMAND}", probe=probes(("refused", "missed"))
    )
    for finding in [*diagnose(facts), *diagnose_running(facts)]:
        words = finding.fix.replace(quoted(f"robot{COMMAND}"), "").replace(quoted(uri), "")
        assert "pwned" not in words


def test_names_of_real_systems_stay_as_they_are() -> None:
    for name in ("/robot_1/camera/image_raw", "192.0.2.7", "robot.local", "~x"):
        assert quoted(name) == (name if name != "~x" else "'~x'")
    assert quoted("/" + "x" * 300) == "NAME"
    assert len(quoted("'" * LONGEST_QUOTED)) <= LONGEST_QUOTED
