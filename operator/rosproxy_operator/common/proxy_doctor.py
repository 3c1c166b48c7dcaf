"""The doctor in a proxy's container: the command, and the findings in the output.

The proxy may be of another version, and the output quotes texts of ROS nodes. So the operator
rejects malformed output, and shortens all texts.
"""

import json
from collections.abc import Mapping, Sequence
from typing import Any

from rosproxy.shared.documents.doctor_finding import DoctorFinding, Severity, warning
from rosproxy.shared.output.text import brief

MOST_FINDINGS = 500
"""The most findings that the operator reads from a proxy's doctor."""
MOST_TEXT_CHARACTERS = 2000
"""Characters of a text at most."""
_SEVERITIES = {severity.name.lower(): severity for severity in Severity}


def command(names: Sequence[str]) -> tuple[str, ...]:
    """Return the command. ``names`` are topics, nodes and services to check; empty: all."""
    # After "--", a name that begins with "-" is no option.
    return ("rosproxy", "doctor", "--json", "--", *names)


def read_findings(proxy: str, output: bytes) -> list[DoctorFinding]:
    """Return the findings in the output of a proxy's doctor. Malformed output is a warning."""
    try:
        rows = json.loads(output)["findings"]
        return [_finding(proxy, row) for row in rows[:MOST_FINDINGS]]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        text = (
            "the output of rosproxy doctor in the proxy's container can't be read. The image may "
            "be of another release"
        )
        return [warning("proxy", proxy, text)]


def _finding(proxy: str, row: Mapping[str, Any]) -> DoctorFinding:
    severity = _SEVERITIES[row["severity"]]
    check, subject, text, fix = (
        brief(str(row[key]), MOST_TEXT_CHARACTERS) for key in ("check", "subject", "text", "fix")
    )
    return DoctorFinding(severity, check, f"{proxy}: {subject}" if subject else proxy, text, fix)
