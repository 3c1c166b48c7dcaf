"""Asking a proxy's own doctor, in its container: the command, and what it prints.

The proxy may be of another version, and what it says quotes what ROS nodes say: nothing is taken
that does not fit.
"""

import json
from collections.abc import Mapping, Sequence
from typing import Any

from rosproxy.admin.doctor_finding import UNKNOWN_NAME, DoctorFinding, Severity, warning
from rosproxy.telemetry.text import brief

MOST_FINDINGS = 500
LONGEST_TEXT = 2000
"""Characters of one text."""
_SEVERITIES = {severity.name.lower(): severity for severity in Severity}


def command(names: Sequence[str]) -> tuple[str, ...]:
    """What is run in a proxy's container, for all or for some topics, nodes and services."""
    # After "--" a name is never taken for an option.
    return ("rosproxy", "doctor", "--json", "--", *names)


def read_findings(proxy: str, output: bytes) -> list[DoctorFinding]:
    """The findings in what a proxy's doctor has printed."""
    try:
        rows = json.loads(output)["findings"]
        return [_finding(proxy, row) for row in rows[:MOST_FINDINGS]]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        text = (
            "the output of rosproxy doctor in the proxy's container can't be read. The image may "
            "be of another release"
        )
        return [warning("proxy", proxy, text)]


def without_names_of_others(
    findings_by_proxy: Sequence[Sequence[DoctorFinding]], names: Sequence[str]
) -> list[DoctorFinding]:
    """The findings of all proxies; a name that one proxy knows is unknown to none.

    Each proxy has a graph of its own, and a topic of ROS 1 is in no domain of ROS 2.
    """
    known = {name for findings in findings_by_proxy for name in _known(findings, names)}
    return [
        finding
        for findings in findings_by_proxy
        for finding in findings
        if finding.check != UNKNOWN_NAME or not known & _words(finding)
    ]


def _known(findings: Sequence[DoctorFinding], names: Sequence[str]) -> set[str]:
    """The names that a proxy says something about."""
    told = {word for f in findings if f.check != UNKNOWN_NAME for word in _words(f)}
    return told & {*names}


def _words(finding: DoctorFinding) -> set[str]:
    """The words of a finding's subject, such as ``proxy a: /topic from /talker to /listener``."""
    return {*finding.subject.split()}


def _finding(proxy: str, row: Mapping[str, Any]) -> DoctorFinding:
    severity = _SEVERITIES[row["severity"]]
    check, subject, text, fix = (
        brief(str(row[key]), LONGEST_TEXT) for key in ("check", "subject", "text", "fix")
    )
    return DoctorFinding(severity, check, f"{proxy}: {subject}" if subject else proxy, text, fix)
