"""``rosproxy doctor``: gather the facts, judge them, print the findings."""

import asyncio
import json

from rosproxy.cli.terminal import size, write
from rosproxy.doctor.collect import DoctorOptions, collect
from rosproxy.doctor.findings import as_json, failed, render
from rosproxy.doctor.rules import diagnose


def examine(options: DoctorOptions, json_wanted: bool) -> int:
    """Examine a proxy and what it stands between; the exit code is 1 if anything is wrong."""
    findings = diagnose(asyncio.run(collect(options)))
    columns, _ = size()
    write(json.dumps(as_json(findings), indent=2) if json_wanted else render(findings, columns))
    return 1 if failed(findings) else 0
