"""Delete the host's conntrack entries for a sandbox's UDP ports after each start of the sandbox.

A datagram to a port that is not published yet creates a conntrack entry without DNAT. The kernel
applies NAT rules to the first datagram of an entry alone, and the entry lasts as long as outside
sends. So later datagrams bypass the published port: the datagrams end at the host, or come from
Docker's port proxy with the gateway's address as source. Docker deletes such entries by itself
since 23.0 (moby, pull request 44742), and needs no flush.

A helper container of the proxy's image deletes the entries. The container joins the host's network,
has NET_ADMIN there, runs ``conntrack`` for the ports of the sandbox, and ends. Deleting a good
entry does no harm: the next datagram creates another entry.

The operator has no disk, so the ended container stays as the record of the last run. The container
runs again after each start of the sandbox, by the operator or by the engine. The container also
runs again when the engine has returned: with live-restore, an engine publishes the ports of running
sandboxes anew.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from msgspec.structs import replace

from rosproxy_operator.docker.planner.actions import Action, CreateFlush, Remove, Run
from rosproxy_operator.docker.planner.instants import instant
from rosproxy_operator.docker.planner.model import Desired, FlushContainer, HostState, Sandbox
from rosproxy_operator.docker.planner.specs import (
    flush_command,
    flush_name,
    helper_config,
    own_labels,
    own_range,
)
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.fingerprint import digest
from rosproxy_operator.proxy_spec.place import Place


@dataclass(frozen=True, slots=True)
class FlushSteps:
    """The actions for the flush of a place. ``fix`` says what users can do if an action fails."""

    place: Place
    actions: tuple[Action, ...]
    fix: str = ""


def flush_config(action: CreateFlush, settings: PlanSettings) -> dict[str, Any]:
    """Return the body of the engine's ``POST /containers/create`` for a flush container."""
    command = flush_command(action.place, action.range)
    return {
        **helper_config(settings, "host"),
        "Entrypoint": [command[0]],
        "Cmd": [*command[1:]],
        "Labels": own_labels(action),
    }


def flush_steps(
    observed: HostState,
    settings: PlanSettings,
    desired: Iterable[Desired],
    outdated: Mapping[str, str],
) -> Iterator[FlushSteps]:
    """Yield the steps that delete all entries made before the ports of a sandbox were published.

    ``outdated`` has the records whose last run does not count, by id, with the time of that run.
    """
    live = {wanted.place for wanted in desired if wanted.live}
    records: dict[Place, list[FlushContainer]] = {}
    for record in observed.flushes:
        records.setdefault(record.place, []).append(record)
    for place in sorted(live | records.keys()):
        existing = records.get(place, [])
        if any(r.container.state == "removing" for r in existing) or _is_busy(place, observed):
            continue
        is_published = bool(observed.sandboxes_of(place)) or place in live
        if observed.deletes_udp_entries or not is_published:
            gone = (Remove(r.container.name, "no longer needed") for r in existing)
            yield FlushSteps(place, tuple(gone))
        elif place in live and (sandbox := _publishing_sandbox(place, observed)):
            steps = _steps(sandbox, existing, outdated, observed, settings)
            yield FlushSteps(place, tuple(steps), _fix(sandbox))


def _is_busy(place: Place, observed: HostState) -> bool:
    """Return whether a record or sandbox of a place has no current inspection yet (`HostState`)."""
    containers = [*observed.flushes, *observed.sandboxes]
    return any(o.place == place and o.container.name in observed.busy for o in containers)


def _publishing_sandbox(place: Place, observed: HostState) -> Sandbox | None:
    """Return the running sandbox of a place that publishes UDP ports; None if there is none."""
    running = (s for s in observed.sandboxes_of(place) if s.container.state == "running")
    return next((s for s in running if s.container.udp_ports), None)


def _steps(
    sandbox: Sandbox,
    records: Iterable[FlushContainer],
    outdated: Mapping[str, str],
    observed: HostState,
    settings: PlanSettings,
) -> Iterator[Action]:
    action = CreateFlush(flush_name(sandbox.place), sandbox.place, sandbox.range)
    body = {**flush_config(action, settings), "Image": observed.image_id}
    action = replace(action, fingerprint=digest(body))
    usable = None
    for record in records:
        if record.fingerprint == action.fingerprint and record.container.state != "dead":
            usable = record
        elif observed.image_id:
            yield Remove(record.container.name, "outdated")
    if usable is None and observed.image_id:
        yield action
        yield Run(action.name)
    elif usable and not _is_current(usable, sandbox, outdated):
        yield Run(usable.container.name)


def _is_current(record: FlushContainer, sandbox: Sandbox, outdated: Mapping[str, str]) -> bool:
    """Return whether a record's last run counts.

    The run must have succeeded, must have begun after the sandbox's last start, and must not be
    ``outdated``.
    """
    ran_at = record.container.started_at
    is_later = instant(ran_at) > instant(sandbox.container.started_at)
    return record.done and is_later and outdated.get(record.container.id) != ran_at


def _fix(sandbox: Sandbox) -> str:
    """Return the command with which users delete the entries themselves."""
    ports = own_range(sandbox.place, sandbox.range)
    return (
        f"Run as root: for port in $(seq {ports.first} {ports.last}); do conntrack -D -p udp "
        "--orig-port-dst $port; done. Until then, datagrams of nodes that went on sending while "
        "the ports were not published may bypass the ports"
    )
