"""Findings: what ``rosproxy doctor`` says, as text and as JSON."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from enum import IntEnum
from typing import Any

from rosproxy.core.text import clean, plural, wrap

MOST_ALIKE = 10
"""Findings of one check with the same mending that are shown one by one."""


class Severity(IntEnum):
    """How bad it is: an error keeps somebody from hearing somebody."""

    OK = 0
    INFO = 1
    WARNING = 2
    ERROR = 3


@dataclass(frozen=True, slots=True)
class Finding:
    """One result: of which ``check``, about which ``subject``, what, and what mends it."""

    severity: Severity
    check: str
    subject: str
    text: str
    fix: str = ""


def failed(findings: Sequence[Finding]) -> bool:
    """Whether anything is wrong."""
    return any(finding.severity is Severity.ERROR for finding in findings)


def as_json(findings: Sequence[Finding]) -> dict[str, Any]:
    """The findings as plain data."""
    rows = [{**asdict(f), "severity": f.severity.name.lower()} for f in findings]
    return {"ok": not failed(findings), "findings": rows}


def render(findings: Sequence[Finding], columns: int) -> str:
    """The findings as text, the worst last, where the eye is when the command has ended."""
    lines: list[str] = []
    for severity in Severity:
        lines += _grouped([f for f in findings if f.severity is severity], columns)
    return "\n".join([*lines, "", _summary(findings)])


def _grouped(findings: Sequence[Finding], columns: int) -> Iterator[str]:
    shown: dict[tuple[str, str], int] = {}
    for finding in findings:
        alike = finding.check, finding.fix
        shown[alike] = shown.get(alike, 0) + 1
        if shown[alike] <= MOST_ALIKE:
            yield from _block(finding, columns)
    for (check, _), count in shown.items():
        if count > MOST_ALIKE:
            yield f"         ... and {count - MOST_ALIKE} more of this kind ({check}); see --json"


def _block(finding: Finding, columns: int) -> Iterator[str]:
    indent = " " * 9
    subject = f"{clean(finding.subject)}: " if finding.subject else ""
    first = f"{_WORDS[finding.severity]:<9}"
    yield from wrap(subject + clean(finding.text), columns, indent, first)
    if finding.fix:
        yield from wrap(clean(finding.fix), columns, f"{indent}  ", f"{indent}> ")


_WORDS = {
    Severity.OK: "ok",
    Severity.INFO: "note",
    Severity.WARNING: "WARNING",
    Severity.ERROR: "ERROR",
}


def _summary(findings: Sequence[Finding]) -> str:
    errors, warnings = (
        sum(f.severity is severity for f in findings)
        for severity in (Severity.ERROR, Severity.WARNING)
    )
    if not errors and not warnings:
        return "Nothing wrong was found."
    return f"{plural(errors, 'error')}, {plural(warnings, 'warning')}."
