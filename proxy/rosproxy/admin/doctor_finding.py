"""A finding: what is well or wrong, and what mends it.

The doctor tells of findings when it is asked (`rosproxy.doctor`), a proxy of those about its own
setting-up by itself (`rosproxy.app.self_check`).
"""

from collections.abc import Sequence
from enum import IntEnum
from functools import partial

import msgspec


class Severity(IntEnum):
    """How bad it is: an error keeps somebody from hearing somebody."""

    OK = 0
    INFO = 1
    WARNING = 2
    ERROR = 3


UNKNOWN_NAME = "unknown name"
"""The check that finds no node, topic or service of a name that was asked for."""


class DoctorFinding(msgspec.Struct, frozen=True):
    """One result: of which ``check``, about which ``subject``, what, and what mends it."""

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
    """Whether anything is wrong."""
    return any(finding.severity is Severity.ERROR for finding in findings)
