"""A finding: what is right or wrong, and the fix.

The doctor reports all findings on request (`rosproxy.doctor`). A proxy reports the findings about
its own set-up by itself (`rosproxy.app.self_check`).
"""

from collections.abc import Sequence
from enum import IntEnum
from functools import partial

import msgspec


class Severity(IntEnum):
    """How bad a finding is. ERROR: at least one connection fails. INFO: a note."""

    OK = 0
    INFO = 1
    WARNING = 2
    ERROR = 3


UNKNOWN_NAME = "unknown name"
"""The ``check`` of this finding: the name in the user's question is no node, topic or service."""


class DoctorFinding(msgspec.Struct, frozen=True):
    """A result of a ``check`` about a ``subject``: what is right or wrong, and what to do."""

    severity: Severity
    check: str
    subject: str
    text: str
    fix: str = ""


ok = partial(DoctorFinding, Severity.OK)
note = partial(DoctorFinding, Severity.INFO)
warning = partial(DoctorFinding, Severity.WARNING)
error = partial(DoctorFinding, Severity.ERROR)


def failed(findings: Sequence[DoctorFinding]) -> bool:
    """Whether there is an ERROR among the findings."""
    return any(finding.severity is Severity.ERROR for finding in findings)


def without_known_names(
    by_source: Sequence[Sequence[DoctorFinding]], names: Sequence[str]
) -> list[DoctorFinding]:
    """All findings, without "unknown name" for names that any source knows.

    ``by_source``: the findings of each source, such as a proxy or a version of ROS. Each source
    knows only its own graph: a topic of ROS 1 is in no domain of ROS 2. ``names``: the names in the
    user's question.
    """
    reported = {
        word
        for findings in by_source
        for finding in findings
        if finding.check != UNKNOWN_NAME
        for word in _words(finding)
    }
    known = reported & {*names}
    return [
        finding
        for findings in by_source
        for finding in findings
        if finding.check != UNKNOWN_NAME or not known & _words(finding)
    ]


def _words(finding: DoctorFinding) -> set[str]:
    """The words of the subject, such as ``proxy a: /topic from /talker to /listener``."""
    return {*finding.subject.split()}
