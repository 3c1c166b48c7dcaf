"""The output of findings."""

from rosproxy.doctor.presentation import MOST_FINDINGS, as_json, render
from rosproxy.doctor.rules import diagnose
from rosproxy.shared.documents.doctor_finding import DoctorFinding, Severity, failed
from tests.unit.doctor.cases import make_facts

OK = DoctorFinding(Severity.OK, "ports", "ports", "100 free")
NOTE = DoctorFinding(Severity.INFO, "node", "nodes", "3 registered")
WARNING = DoctorFinding(Severity.WARNING, "time", "", "no clock", "rosparam set")
ERROR_OF_MASTER = DoctorFinding(
    Severity.ERROR, "master", "master", "refuses connections", "start roscore"
)
ERROR = DoctorFinding(Severity.ERROR, "node", "/talker", "gone", "rosnode cleanup")


def test_a_sound_system_gives_no_errors() -> None:
    findings = diagnose(make_facts())
    assert {f.severity for f in findings} == {Severity.OK}
    assert render(findings, 100).endswith("\n\nNothing wrong was found.")
    assert not failed(findings)


def test_the_worst_finding_stands_last_and_each_has_its_fix() -> None:
    assert render([ERROR, WARNING, NOTE, OK, ERROR], 80).split("\n") == [
        "ok       ports: 100 free",
        "note     nodes: 3 registered",
        "WARNING  no clock",
        "         > rosparam set",
        "ERROR    /talker: gone",
        "ERROR    /talker: gone",
        "         > rosnode cleanup",
        "",
        "2 errors, 1 warning. Begin with /talker: the other findings may follow from it.",
    ]


def test_only_errors_fail() -> None:
    assert failed([OK, ERROR])
    assert not failed([OK, NOTE, WARNING])


def test_as_json() -> None:
    assert as_json([OK, ERROR]) == {
        "ok": False,
        "findings": [
            {
                "severity": "ok",
                "check": "ports",
                "subject": "ports",
                "text": "100 free",
                "fix": "",
            },
            {
                "severity": "error",
                "check": "node",
                "subject": "/talker",
                "text": "gone",
                "fix": "rosnode cleanup",
            },
        ],
    }


def test_many_of_a_kind_are_counted() -> None:
    many = [
        DoctorFinding(Severity.ERROR, "stale", f"/node_{n}", "gone", "cleanup") for n in range(300)
    ]
    lines = render(many, 80).split("\n")
    assert lines[9:12] == [
        "ERROR    /node_9: gone",
        "         ... and 290 more like this (stale): see --json",
        "         > cleanup",
    ]
    assert lines[-1] == "300 errors, 0 warnings."


def test_names_cannot_reach_the_terminal() -> None:
    evil = DoctorFinding(Severity.ERROR, "node", "\x1b[2J", "\x1b]0;owned\x07\r", "\u202ehcum os")
    assert all(line.isprintable() for line in render([evil], 80).split("\n"))


def test_commands_are_not_torn_apart() -> None:
    command = "docker run -p 45000-45099:45000-45099"
    text = render([DoctorFinding(Severity.ERROR, "range", "range", "x " * 60, command)], 30)
    assert "45000-45099:45000-45099" in text


def test_long_texts_lose_their_middle_and_no_character_moves_the_cursor() -> None:
    """A node at the master may have a name of megabytes."""
    hostile = DoctorFinding(Severity.ERROR, "node", "/\x1b[2J" * 10**5, "x" * 10**6, "y" * 10**6)
    shown = render([hostile], 80)
    (row,) = as_json([hostile])["findings"]
    assert len(shown) < 5000
    assert "\x1b" not in shown + str(row)
    assert [len(row[key]) for key in ("subject", "text", "fix")] == [200, 1000, 1000]


def test_many_findings_of_a_check_hide_no_other() -> None:
    many = [
        DoctorFinding(Severity.ERROR, "node", f"/n{n}", "silent", f"nc -vz evil {n}")
        for n in range(MOST_FINDINGS)
    ]
    lines = render([ERROR_OF_MASTER, *many], 80).split("\n")
    assert lines[0] == "ERROR    master: refuses connections"
    assert "         ... and 4970 more findings (node): see --json" in lines
    assert len(lines) < 100
    rows = as_json([*many, ERROR_OF_MASTER])["findings"]
    assert len(rows) == MOST_FINDINGS + 1
    assert rows[-2]["subject"] == "master"
    assert rows[-1]["text"] == "not shown: 1 more finding"
