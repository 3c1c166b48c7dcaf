"""The findings of ``rosproxy doctor``, as text and as JSON.

Findings quote names that nodes have chosen, and any program can register nodes at the master. So
this module bounds the texts and the number of findings.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import msgspec
from msgspec.structs import replace

from rosproxy.shared.documents.doctor_finding import DoctorFinding, Severity, failed, note
from rosproxy.shared.documents.status_bounds import fair_choice
from rosproxy.shared.output.text import brief, plural, wrap

MOST_ALIKE = 10
"""Findings of the same check with the same fix that are shown at most."""
MOST_GROUPS = 30
"""Groups of such findings of the same check and severity that are shown at most."""
MOST_FINDINGS = 5000
"""Findings in the JSON at most, with fair shares for each check."""
LONGEST_SUBJECT = 200
LONGEST_TEXT = 1000
"""Characters of a subject, and of a text or fix. A longer one loses its middle."""
INDENT = " " * 9


_SEVERITY_WORDS = {
    Severity.OK: "ok",
    Severity.INFO: "note",
    Severity.WARNING: "WARNING",
    Severity.ERROR: "ERROR",
}


def as_json(findings: Sequence[DoctorFinding]) -> dict[str, Any]:
    """The findings as dicts and lists, ready for JSON."""
    shown = [*map(_bounded, fair_choice(findings, lambda f: f.check, MOST_FINDINGS))]
    if left_out := len(findings) - len(shown):
        shown.append(note("doctor", "doctor", f"not shown: {plural(left_out, 'more finding')}"))
    rows = [{**msgspec.structs.asdict(f), "severity": f.severity.name.lower()} for f in shown]
    return {"ok": not failed(findings), "findings": rows}


def render(findings: Sequence[DoctorFinding], columns: int) -> str:
    """The findings as text, wrapped to ``columns``. The worst are last, next to the prompt."""
    lines: list[str] = []
    for severity in Severity:
        of_severity = [_bounded(f) for f in findings if f.severity is severity]
        lines += _grouped(of_severity, columns)
    return "\n".join([*lines, "", _summary(findings)])


def _grouped(findings: Sequence[DoctorFinding], columns: int) -> Iterator[str]:
    """The lines of findings, grouped by check and fix; the fix follows the group."""
    alike: dict[tuple[str, str], list[DoctorFinding]] = {}
    for finding in findings:
        alike.setdefault((finding.check, finding.fix), []).append(finding)
    groups_of = Counter[str]()
    left_out = Counter[str]()
    for (check, fix), group in alike.items():
        groups_of[check] += 1
        if groups_of[check] > MOST_GROUPS:
            left_out[check] += len(group)
            continue
        for finding in group[:MOST_ALIKE]:
            subject = f"{finding.subject}: " if finding.subject else ""
            first = f"{_SEVERITY_WORDS[finding.severity]:<{len(INDENT)}}"
            yield from wrap(subject + finding.text, columns, INDENT, first)
        if len(group) > MOST_ALIKE:
            yield f"{INDENT}... and {len(group) - MOST_ALIKE} more like this ({check}): see --json"
        yield from wrap(fix, columns, f"{INDENT}  ", f"{INDENT}> ")
    for check, count in left_out.items():
        yield f"{INDENT}... and {plural(count, 'more finding')} ({check}): see --json"


def _bounded(finding: DoctorFinding) -> DoctorFinding:
    """A finding with clean texts of bounded length."""
    return replace(
        finding,
        subject=brief(finding.subject, LONGEST_SUBJECT),
        text=brief(finding.text, LONGEST_TEXT),
        fix=brief(finding.fix, LONGEST_TEXT),
    )


def _summary(findings: Sequence[DoctorFinding]) -> str:
    severities = [finding.severity for finding in findings]
    errors = severities.count(Severity.ERROR)
    warnings = severities.count(Severity.WARNING)
    if not errors and not warnings:
        return "Nothing wrong was found."
    counts = f"{plural(errors, 'error')}, {plural(warnings, 'warning')}."
    worst = [f for f in findings if f.severity is max(severities)]
    # If a single fix corrects all findings, no advice where to begin is needed.
    if len({f.fix for f in findings if f.severity >= Severity.WARNING}) == 1:
        return counts
    first = brief(worst[0].subject or worst[0].check, LONGEST_SUBJECT)
    return f"{counts} Begin with {first}: the other findings may follow from it."
