"""The findings of ``rosproxy doctor``, as text and as JSON."""

from collections.abc import Iterator, Sequence
from typing import Any

import msgspec

from rosproxy.admin.doctor_finding import DoctorFinding, Severity, failed
from rosproxy.telemetry.text import clean, plural, wrap

MOST_ALIKE = 10
"""Findings of the same check with the same fix that are shown at most."""
INDENT = " " * 9


_SEVERITY_WORDS = {
    Severity.OK: "ok",
    Severity.INFO: "note",
    Severity.WARNING: "WARNING",
    Severity.ERROR: "ERROR",
}


def as_json(findings: Sequence[DoctorFinding]) -> dict[str, Any]:
    """The findings as dicts and lists, ready for JSON."""
    rows = [{**msgspec.structs.asdict(f), "severity": f.severity.name.lower()} for f in findings]
    return {"ok": not failed(findings), "findings": rows}


def render(findings: Sequence[DoctorFinding], columns: int) -> str:
    """The findings as text, wrapped to ``columns``. The worst are last, next to the prompt."""
    lines: list[str] = []
    for severity in Severity:
        lines += _grouped([f for f in findings if f.severity is severity], columns)
    return "\n".join([*lines, "", _summary(findings)])


def _grouped(findings: Sequence[DoctorFinding], columns: int) -> Iterator[str]:
    """The lines of findings, grouped by check and fix; the fix follows the group."""
    alike: dict[tuple[str, str], list[DoctorFinding]] = {}
    for finding in findings:
        alike.setdefault((finding.check, finding.fix), []).append(finding)
    for (check, fix), group in alike.items():
        for finding in group[:MOST_ALIKE]:
            subject = f"{clean(finding.subject)}: " if finding.subject else ""
            first = f"{_SEVERITY_WORDS[finding.severity]:<{len(INDENT)}}"
            yield from wrap(subject + clean(finding.text), columns, INDENT, first)
        if len(group) > MOST_ALIKE:
            yield f"{INDENT}... and {len(group) - MOST_ALIKE} more like this ({check}): see --json"
        yield from wrap(clean(fix), columns, f"{INDENT}  ", f"{INDENT}> ")


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
    first = clean(worst[0].subject or worst[0].check)
    return f"{counts} Begin with {first}: the other findings may follow from it."
