"""``rosproxy-operator docker doctor``: the faults of a host.

First come the findings of the operator: images, networks, masters, labels, and remaining steps.
Fatal problems come before warnings, and causes before consequences. Then come the findings of the
doctors, which check from the proxies' networks. A doctor runs in the container of each running
proxy (``docker exec``), unless the proxy has just been started.
"""

import asyncio
from collections.abc import Iterator, Sequence

from rosproxy.doctor.rules.participant import OTHER_DOMAIN, OWN_MACHINE, UNSELECTED
from rosproxy.shared.documents.doctor_finding import (
    DoctorFinding,
    error,
    note,
    ok,
    warning,
    without_known_names,
)
from rosproxy.shared.output.text import plural
from rosproxy_operator.common.proxy_client import Json
from rosproxy_operator.common.proxy_doctor import command, read_findings
from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.docker.engine_client import DockerClient
from rosproxy_operator.docker.errors import EngineError
from rosproxy_operator.docker.host_status import HostStatus

MOST_DOCTORS = 4
"""The highest number of doctors that run at the same time: each is a Python process."""
_SUBJECT_KINDS = ("engine", "proxy image", "network", "master", "container", "proxy")
"""The kinds of subjects, causes before consequences."""
_UNFINISHED_STATES = ("absent", "created")
"""States of a proxy's container while an operator creates the proxy."""


def examine(host: HostStatus, names: Sequence[str]) -> list[DoctorFinding]:
    """Return all findings. Raises EngineError.

    ``names`` are the topics, nodes and services that the doctors of the proxies check; empty: all.
    """
    return asyncio.run(_examine(host, names))


async def _examine(host: HostStatus, names: Sequence[str]) -> list[DoctorFinding]:
    status = await host.now()
    engine = DockerClient()
    limit = asyncio.Semaphore(MOST_DOCTORS)

    async def ask(name: str) -> list[DoctorFinding]:
        async with limit:
            try:
                output = await in_thread(engine.run, name, *command(names))
            except EngineError as failure:
                text = f"rosproxy doctor could not run in the proxy's container: {failure}"
                return [warning("proxy", f"proxy {name}", text, f"read docker logs {name}")]
        return read_findings(f"proxy {name}", output)

    subjects = {problem["subject"] for problem in status["problems"]}
    running = [proxy for proxy in status["proxies"] if proxy["state"] == "running"]
    # A silent proxy without a problem has just been started.
    asked = [p["name"] for p in running if p["reachable"] or f"proxy {p['name']}" in subjects]
    findings = without_known_names(await asyncio.gather(*map(ask, asked)), names)
    if any(map(_participant_of, findings)):
        # A proxy may have begun to serve a participant while the doctors ran.
        served = served_participants(status) | served_participants(await host.now())
        findings = [f for f in findings if _participant_of(f) not in served]
    return [*host_findings(status), *findings]


def served_participants(status: Json) -> frozenset[str]:
    """Return the GUID prefixes of the participants that the proxies of this host serve."""
    participants = (p for c in status["containers"] for p in c["participants"])
    return frozenset(p["guid_prefix"] for p in participants)


def _participant_of(finding: DoctorFinding) -> str:
    """Return the GUID prefix of a participant that another proxy of this host may serve, or empty.

    The doctor of a proxy knows no other proxy. So the doctor warns that such a participant is in
    another domain, announces itself on its own machine only, or is not selected.
    """
    is_about_participant = finding.check in (OTHER_DOMAIN, OWN_MACHINE, UNSELECTED)
    return finding.subject.rpartition(" ")[2] if is_about_participant else ""


def host_findings(status: Json) -> Iterator[DoctorFinding]:
    """Yield the findings in the status of a host.

    First come the fatal problems, then the warnings, both with causes before consequences. Then
    come proxies that do not run, steps that are left, and the number of containers with a proxy.
    """
    problems = sorted(status["problems"], key=_order)
    for problem in problems:
        report = error if problem["fatal"] else warning
        subject = problem["subject"]
        yield report(subject.partition(" ")[0], subject, problem["text"], problem.get("fix", ""))
    # If an operator runs, its failed steps are among the problems.
    runs = bool(status["operator"])
    for proxy in status["proxies"]:
        if proxy["state"] != "running":
            report = note if runs and proxy["state"] in _UNFINISHED_STATES else error
            text = f"the proxy's container is {proxy['state']}"
            fix = f"check that the operator runs; read docker logs {proxy['name']}"
            yield report("proxy", f"proxy {proxy['name']}", text, fix)
    if status["actions"]:
        text = f"{plural(len(status['actions']), 'step')} left, the first: "
        fix = "start the operator if none runs; rosproxy-operator docker plan lists the steps"
        report = note if runs else warning
        yield report("operator", "operator", text + status["actions"][0], fix)
    members = {c["name"] for c in status["containers"] if c["proxy"]}
    if members:
        text = f"{plural(len(members), 'container')} with a proxy"
        yield ok("host", "host", text)
    elif not problems and not status["containers"]:
        fix = "docker run --label rosproxy.enable=true ..."
        yield warning("host", "host", "no container is labelled, so no container has a proxy", fix)


def _order(problem: Json) -> tuple[bool, int]:
    kinds = [kind for kind in _SUBJECT_KINDS if problem["subject"].startswith(kind)]
    # The first kind: "proxy image" also begins with "proxy", and stands before "proxy".
    return not problem["fatal"], _SUBJECT_KINDS.index(kinds[0]) if kinds else len(_SUBJECT_KINDS)
