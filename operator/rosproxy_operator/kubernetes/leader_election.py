"""Leader election among operators: reads the Lease, and writes it when it may.

`planner.leadership` decides; here are the clock, the requests and the notification of a change.
The `leaderelection` of the `kubernetes` client does not do: it relies on the wall clock, renews in
a loop that nobody can end and that never releases the Lease, and does not say until when its
leader may act. kopf's peering says of itself that it locks nothing.
"""

import asyncio
import logging
import random
import socket
import time
import uuid
from collections.abc import Callable
from datetime import UTC, datetime

from rosproxy_operator.common.operator_metrics import ClusterMetrics
from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.kubernetes.api.api_client import (
    LEASES,
    SOON,
    Api,
    ApiConflict,
    ApiError,
    ApiNotFound,
)
from rosproxy_operator.kubernetes.planner import leadership
from rosproxy_operator.kubernetes.planner.leadership import LOOK, RENEW, Candidate, LeaseRecord
from rosproxy_operator.kubernetes.resources.checks import int_at, submap, text_at
from rosproxy_operator.kubernetes.resources.model import Json, Name

log = logging.getLogger(__name__)

LONGEST = 60.0
"""Seconds that a Lease may last at most: no operator here has written a longer one."""


def clock() -> float:
    """Seconds of a clock that nobody sets, and that goes on while the machine sleeps."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class LeaderElection:
    """This operator's candidacy. Without a ``lease`` it has no rivals, and leads from the start.

    `leads` may be asked from any thread, all else belongs to the event loop.
    """

    def __init__(self, api: Api, lease: Name | None, metrics: ClusterMetrics) -> None:
        self._api = api
        self._lease = lease
        self._metrics = metrics
        self._candidate = Candidate(f"{socket.gethostname()}_{uuid.uuid4()}")
        self._leaving = False
        self._lock = asyncio.Lock()
        self._shown = (-1, "")  # no term has this number, so the first state is reported
        self._error = ""
        metrics.leader.set(lease is None)

    def leads(self) -> bool:
        """Whether this operator may act, at this moment."""
        return self._lease is None or self._candidate.leads(clock())

    def term(self) -> int:
        """The number of this operator's present term, from 1; 0: it does not lead."""
        return (1 if self._lease is None else self._candidate.terms) if self.leads() else 0

    async def run(self, changed: Callable[[], None]) -> None:
        """Take part until it has left, or is cancelled. ``changed``: it leads now, or no more."""
        while self._lease is not None and not self._leaving:
            async with self._lock:
                if not self._leaving:
                    self._candidate = await in_thread(self._round, self._candidate, self._lease)
            self._show(changed)
            # Candidates are spread in time; a leader that fails to renew has little time left.
            calm = self.leads() and not self._error
            await asyncio.sleep(RENEW if calm else LOOK * random.uniform(0.5, 1.0))  # noqa: S311
        await asyncio.Event().wait()  # the process ends with the first task that does (`run`)

    def resign(self) -> None:
        """Lead no more. The Lease is kept until `release`."""
        self._leaving = self._lease is not None
        self._candidate = leadership.after_resignation(self._candidate)

    async def release(self) -> None:
        """Let another operator lead at once: this one has stopped acting."""
        async with self._lock:  # a renewal may be under way
            # If one was, its result has replaced what `resign` had noted.
            self._candidate = leadership.after_resignation(self._candidate)
            if self._lease is not None:
                await in_thread(self._release, self._lease)
        self._metrics.leader.set(0)

    def _round(self, candidate: Candidate, lease: Name) -> Candidate:
        """Look at the Lease once, and write it if that is right."""
        try:
            candidate = leadership.observe(candidate, self._read(lease), clock())
            record = leadership.next_record(candidate, clock())
            if record is not None:
                begun = clock()
                self._write(lease, record)
                candidate = leadership.after_write(candidate, record, begun, clock())
            self._error = ""
        except ApiConflict:
            log.debug("Lease %s: another operator was faster", lease)
        except ApiError as error:
            if str(error) != self._error:
                log.warning("Lease %s: %s", lease, error)
            self._error = str(error)
        return candidate

    def _release(self, lease: Name) -> None:
        try:
            record = leadership.released_record(self._read(lease), self._candidate.name)
            if record is not None:
                self._write(lease, record)
                log.info("this operator no longer leads: Lease %s released", lease)
        except ApiError as error:
            log.warning(
                "Lease %s not released: %s. Another operator leads when the Lease expires",
                lease,
                error,
            )

    def _read(self, lease: Name) -> LeaseRecord | None:
        try:
            return lease_record(self._api.get(LEASES, lease, SOON))
        except ApiNotFound:
            return None

    def _write(self, lease: Name, record: LeaseRecord) -> None:
        """Write it if it is still as it was read. Raises ApiError."""
        spec = lease_spec(record, datetime.now(UTC))
        if not record.version:
            meta = {"namespace": lease.namespace, "name": lease.name}
            kind = {"apiVersion": "coordination.k8s.io/v1", "kind": "Lease"}
            self._api.create(LEASES, {**kind, "metadata": meta, "spec": spec}, SOON)
            return
        operations: list[Json] = [
            {"op": "test", "path": "/metadata/resourceVersion", "value": record.version},
            {"op": "add", "path": "/spec", "value": spec},
        ]
        self._api.patch(LEASES, lease, operations, SOON)

    def _show(self, changed: Callable[[], None]) -> None:
        """Report who leads, if that has changed."""
        term = self.term()
        record = self._candidate.record
        rival = record.holder if record and record.holder != self._candidate.name else ""
        holder = self._candidate.name if term else rival
        previous = self._shown
        self._shown = (term, holder)
        if self._shown == previous:
            return
        self._metrics.leader.set(bool(term))
        if previous[1] != holder and previous[0] >= 0:
            self._metrics.leader_changes.inc()
        if term:
            log.info("this operator leads now (%s)", holder)
        else:
            log.info("this operator stands by: %s leads", holder or "no operator")
        changed()


def lease_record(obj: Json) -> LeaseRecord:
    """A Lease, as k8s.io/api, coordination/v1/types.go, has it."""
    spec = submap(obj, "spec")
    return LeaseRecord(
        version=text_at(submap(obj, "metadata"), "resourceVersion"),
        holder=text_at(spec, "holderIdentity"),
        duration=min(float(int_at(spec, "leaseDurationSeconds")), LONGEST),
        transitions=int_at(spec, "leaseTransitions"),
        acquired=text_at(spec, "acquireTime"),
    )


def lease_spec(record: LeaseRecord, now: datetime) -> Json:
    """The spec of a Lease that is written ``now``; one that is taken says when that was."""
    timestamp = now.strftime("%Y-%m-%dT%H:%M:%S.%fZ")
    return {
        "holderIdentity": record.holder,
        "leaseDurationSeconds": int(record.duration),
        "leaseTransitions": record.transitions,
        "acquireTime": record.acquired or timestamp,
        "renewTime": timestamp,
    }
