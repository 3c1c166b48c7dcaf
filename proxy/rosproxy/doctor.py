"""``rosproxy doctor``: gather the facts, judge them, print the findings."""

import asyncio
import json

from rosproxy.console import size, write
from rosproxy.core.doctor import diagnose
from rosproxy.core.doctor.findings import as_json, failed, render
from rosproxy.survey import Patient, survey


def examine(patient: Patient, json_wanted: bool) -> int:
    """Examine a proxy and what it stands between; the exit code is 1 if anything is wrong."""
    findings = diagnose(asyncio.run(survey(patient)))
    columns, _ = size()
    write(json.dumps(as_json(findings), indent=2) if json_wanted else render(findings, columns))
    return 1 if failed(findings) else 0
