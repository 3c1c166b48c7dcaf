"""Asking a proxy's own doctor, in its container: the command, and what it prints.

The proxy may be of another version, and what it says quotes what ROS nodes say: nothing is taken
that does not fit.
"""

import json
from collections.abc import Mapping, Sequence
from typing import Any

from rosproxy.admin.doctor_finding import DoctorFinding, Severity, warning
from rosproxy.telemetry.text import brief

MOST_FINDINGS = 500
LONGEST_TEXT = 2000
"""Characters of one text."""
_SEVERITIES = {severity.name.lower(): severity for severity in Severity}


def command(names: Sequence[str]) -> tuple[str, ...]:
    """What is run in a proxy's container, for all or for some topics, nodes and services."""
    # After "--" a name is never taken for an option.
    return ("rosproxy", "doctor", "--json", "--", *names)


def read_findings(proxy: str, output: bytes, cures: Mapping[str, str]) -> list[DoctorFinding]:
    """The findings in what a proxy's doctor has printed; ``cures`` by checks stand for its own."""
    try:
        rows = json.loads(output)["findings"]
        return [_finding(proxy, row, cures) for row in rows[:MOST_FINDINGS]]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        text = "its own doctor says nothing that can be read: its image may be of another release"
        return [warning("proxy", proxy, text)]


def _finding(proxy: str, row: Mapping[str, Any], cures: Mapping[str, str]) -> DoctorFinding:
    severity = _SEVERITIES[row["severity"]]
    check, subject, text, fix = (
        brief(str(row[key]), LONGEST_TEXT) for key in ("check", "subject", "text", "fix")
    )
    if severity >= Severity.WARNING:
        fix = cures.get(check, fix)
    return DoctorFinding(severity, check, f"{proxy}: {subject}" if subject else proxy, text, fix)
