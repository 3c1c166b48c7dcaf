"""The doctor's findings about the proxy, the master and the ports."""

from typing import Any

import pytest

from rosproxy.doctor.facts import Attempt, DoctorFacts, ReachOutcome
from rosproxy.doctor.rules import proxy as proxy_rules
from rosproxy.shared.documents.doctor_finding import DoctorFinding, Severity
from tests.unit.doctor.cases import (
    make_facts,
    make_master,
    only,
    probes,
    without_proxy,
)
from tests.unit.status_json import make_node, make_status


def check(facts: DoctorFacts) -> list[DoctorFinding]:
    return [*proxy_rules.check(facts)]


def of(check_name: str, facts: DoctorFacts) -> list[DoctorFinding]:
    return [f for f in check(facts) if f.check == check_name]


def test_a_sound_proxy() -> None:
    assert [(f.severity, f.check) for f in check(make_facts())] == [
        (Severity.OK, "admin"),
        (Severity.OK, "master"),
        (Severity.OK, "published range"),
        (Severity.OK, "ports"),
    ]


def test_a_status_that_leaves_something_out() -> None:
    facts = make_facts(status=make_status(make_node(left_out=1234)))
    (whole, cut) = of("admin", facts)
    assert (whole.severity, cut.severity) == (Severity.OK, Severity.INFO)
    assert "leaves out 1234 names and entries" in cut.text


def test_no_proxy_answers() -> None:
    finding = only(check(without_proxy()))
    assert (finding.severity, finding.check) == (Severity.ERROR, "admin")
    assert "no rosproxy answers" in finding.text
    assert "docker exec CONTAINER rosproxy doctor" in finding.fix


def test_a_look_from_outside_does_not_ask_for_a_proxy() -> None:
    findings = check(without_proxy(admin_error="", advertise_host=""))
    assert [f.check for f in findings] == ["master"]


def test_without_proxy_and_settings_the_checks_say_what_they_need() -> None:
    facts = without_proxy(master=None, advertise_host="", advertised_addresses=())
    notes = [f for f in check(facts) if f.severity is Severity.INFO]
    master, host = notes
    assert "--master-uri http://HOST:11311" in master.fix
    assert "--advertise-host ADDRESS" in host.fix


@pytest.mark.parametrize(
    ("master", "text", "fix"),
    [
        (make_master(ReachOutcome.REFUSED), "no roscore runs there", "on robot: roscore -p 11311"),
        (make_master(ReachOutcome.SILENT), "does not answer", "nc -vz robot 11311"),
        (
            make_master(ReachOutcome.UNRESOLVABLE, addresses=()),
            "the host name robot can't be resolved here",
            "docker run --add-host robot:ADDRESS",
        ),
        (
            make_master(
                ReachOutcome.STRANGER, "HTTP status 404", uri="http://robot:11311/x", at_root=True
            ),
            "not at the path /x. A ROS master answers only / and /RPC2",
            "--master-uri http://robot:11311/",
        ),
        (
            make_master(ReachOutcome.STRANGER, "HTTP status 404"),
            "is no ROS master (HTTP status 404)",
            "--master-uri http://HOST:11311",
        ),
        (
            make_master(ReachOutcome.STRANGER, is_this_proxy=True),
            "leads back to this proxy itself",
            "--master-uri http://HOST:11311",
        ),
        (
            make_master(
                ReachOutcome.REFUSED, uri="http://localhost:11311", addresses=("127.0.0.1",)
            ),
            "In a container, localhost is the container itself",
            "--master-uri http://ADDRESS:11311",
        ),
    ],
)
def test_the_master_is_not_there(master: Any, text: str, fix: str) -> None:
    finding = only(check(make_facts(master=master, graph=None)))
    assert (finding.severity, finding.check) == (Severity.ERROR, "master")
    assert text in finding.text
    assert fix in finding.fix


def test_the_master_answers_the_doctor_but_not_the_proxy() -> None:
    status = make_status(make_node(), master={"up": False, "error": "no answer in time"})
    finding = only(check(make_facts(status=status)))
    assert finding.severity is Severity.WARNING
    assert "answers the doctor, but the proxy reports: no answer in time" in finding.text


def test_a_proxy_that_has_not_asked_its_master_yet_is_sound() -> None:
    status = make_status(make_node(), master={"up": False, "error": ""})
    assert not [f for f in check(make_facts(status=status)) if f.severity > Severity.INFO]


def test_a_master_that_keeps_its_state_to_itself() -> None:
    assert "does not list its nodes and topics" in only(check(make_facts(graph=None))).text


def test_a_loopback_address_is_advertised() -> None:
    finding = only(of("advertised host", make_facts(advertise_host="127.0.0.1")))
    assert finding.severity is Severity.ERROR
    assert "--advertise-host ADDRESS" in finding.fix


@pytest.mark.parametrize(
    "master",
    [
        make_master(uri="http://localhost:11311"),
        make_master(addresses=("127.0.1.1",)),
    ],
)
def test_loopback_is_fine_where_all_is_on_one_machine(master: Any) -> None:
    assert not of("advertised host", make_facts(advertise_host="127.0.0.1", master=master))


@pytest.mark.parametrize(
    ("ros", "domain", "is_fault"),
    [
        (["2"], {"peers": ["127.0.0.1", "[::1]:11400"]}, False),
        (["2"], {"peers": ["127.0.0.1"], "lan_relay": "172.17.0.1:7500"}, True),
        (["2"], {"peers": ["127.0.0.1", "192.0.2.7:11400"]}, True),
        (["2"], {}, True),
        (["1", "2"], {}, False),
        (["1", "2"], {"peers": ["192.0.2.7"]}, True),
    ],
)
def test_loopback_is_fine_where_all_peers_are_on_this_machine(
    ros: list[str], domain: dict[str, Any], is_fault: bool
) -> None:
    status = {**make_status(make_node(), settings={"ros": ros}), "domains": [domain]}
    master = make_master(uri="http://localhost:11311") if "1" in ros else None
    facts = make_facts(advertise_host="127.0.0.1", status=status, master=master)
    assert bool(of("advertised host", facts)) == is_fault


def test_an_advertised_name_that_is_unknown_here() -> None:
    finding = only(of("advertised host", without_proxy(advertised_addresses=())))
    assert "robot-host can't be resolved here" in finding.text


@pytest.mark.parametrize(
    ("outcome", "severity", "text", "fix"),
    [
        (("ok", "ok"), Severity.OK, "the master reaches robot-host, port 45001 and 45099", ""),
        (("ok", "unknown"), Severity.OK, "The master could not be asked", ""),
        (("refused", "ok"), Severity.OK, "(the proxy does not: refused. This is no fault)", ""),
        (
            ("ok", "missed"),
            Severity.ERROR,
            "reached by the proxy, but not from the master's machine",
            "nc -vz robot-host 45099",
        ),
        (
            ("refused", "missed"),
            Severity.ERROR,
            "A call from the master does not arrive either",
            "docker run -p 46000-46099:45000-45099, and let the firewall accept it",
        ),
        (("silent", "missed"), Severity.ERROR, "A firewall drops the packets", "docker run -p"),
        (("refused", "unknown"), Severity.WARNING, "as with some NAT. The master", "docker run -p"),
        (("closed", "unknown"), Severity.ERROR, "does not reach the proxy", "docker run"),
        (("stranger", "missed"), Severity.ERROR, "another program accepts", "docker run -p"),
        (
            ("unresolvable", "missed"),
            Severity.ERROR,
            "the host name can't be resolved here",
            "give an address instead of the name: set --advertise-host ADDRESS",
        ),
    ],
)
def test_tries_at_the_published_range(
    outcome: tuple[str, str], severity: Severity, text: str, fix: str
) -> None:
    status = make_status(make_node(), ports={"advertise": "46000-46099"})
    (finding,) = of("published range", make_facts(status=status, probe=probes(outcome, outcome)))
    assert finding.severity is severity
    assert text in finding.text
    assert fix in finding.fix


def test_a_range_that_is_published_in_part() -> None:
    facts = make_facts(probe=probes(("ok", "ok"), ("refused", "missed")))
    finding = only(of("published range", facts))
    assert finding.text.startswith("robot-host, port 45099: connection refused")
    assert finding.fix == (
        "publish the whole range: docker run -p 45000-45099:45000-45099, and let the firewall "
        "accept it"
    )


def test_a_range_that_could_not_be_tried() -> None:
    finding = only(of("published range", make_facts(probe=None, probe_error="HTTP 500")))
    assert (finding.severity, finding.text) == (Severity.WARNING, "not tried: HTTP 500")


def test_no_port_is_left_to_try() -> None:
    assert not of("published range", make_facts(probe={"probes": []}))


@pytest.mark.parametrize(
    ("ports", "severity", "text"),
    [
        ({"used": 100, "free": 0}, Severity.ERROR, "no port is free, 100 used"),
        ({"used": 95, "free": 5}, Severity.WARNING, "only 5 free, 95 used"),
        ({"used": 90, "free": 10}, Severity.OK, "90 used, 10 free"),
    ],
)
def test_how_many_ports_are_left(ports: dict[str, int], severity: Severity, text: str) -> None:
    (finding,) = of("ports", make_facts(status=make_status(ports=ports)))
    assert finding.severity is severity
    assert text in finding.text
    is_refused = severity is Severity.ERROR
    assert finding.fix.endswith("Then restart the ROS 1 nodes that got no port") is is_refused


def test_ports_that_other_programs_hold() -> None:
    finding = only(of("ports", make_facts(status=make_status(ports={"blocked": 1, "free": 99}))))
    assert finding.text == "other programs hold 1 port of the range 45000-45099"
    assert "ss -ltnp 'sport >= :45000 and sport <= :45099'" in finding.fix


@pytest.mark.parametrize(
    ("attempt", "outcome", "severity"),
    [
        (Attempt(ReachOutcome.ANSWERED), ("ok", "ok"), Severity.OK),
        (Attempt(ReachOutcome.REFUSED), ("ok", "ok"), Severity.ERROR),
        (Attempt(ReachOutcome.REFUSED), ("refused", "ok"), Severity.WARNING),
    ],
)
def test_the_published_master(
    attempt: Attempt, outcome: tuple[str, str], severity: Severity
) -> None:
    status = make_status(make_node(), settings={"publish_master": 11411})
    facts = make_facts(status=status, published_master=attempt, probe=probes(outcome, outcome))
    (finding,) = of("published master", facts)
    assert finding.severity is severity
    assert "http://robot-host:11411" in finding.text
