"""Leader election among operators: reads and writes the Lease object.

`planner.leadership` decides. This module has the clock, the requests and the call that reports a
change. Two alternatives were rejected. The `leaderelection` of the `kubernetes` client relies on
the wall clock and does not say until when the leader may act. Its loop can't be stopped, and never
releases the Lease object. The peering of kopf has no locks, as its documentation says.
"""

import asyncio
import logging
import os
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
from rosproxy_operator.kubernetes.planner.leadership import (
    RENEWAL_INTERVAL_S,
    STANDBY_READ_INTERVAL_S,
    Candidate,
    LeaseRecord,
)
from rosproxy_operator.kubernetes.resources.checks import int_at, submap, text_at
from rosproxy_operator.kubernetes.resources.model import Json, Name

log = logging.getLogger(__name__)

MOST_LEASE_DURATION_S = 60.0
"""Upper bound for the seconds that a Lease object lasts. No operator here writes a longer time."""


def clock() -> float:
    """Return the seconds of a clock that can't be set, and that runs while the machine sleeps."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class LeaderElection:
    """The candidacy of this operator. Without a ``lease``, this operator leads from the start.

    `leads` is safe in any thread. All other methods belong to the event loop.
    """

    def __init__(self, api: Api, lease: Name | None, metrics: ClusterMetrics) -> None:
        self._api = api
        self._lease = lease
        self._metrics = metrics
        self._candidate = Candidate(f"{_own_name()}_{uuid.uuid4()}")
        self._leaving = False
        self._lock = asyncio.Lock()
        self._shown = (-1, "")  # no term has this number, so `_show` reports the first state
        self._error = ""
        metrics.leader.set(lease is None)

    def leads(self) -> bool:
        """Whether this operator may act at this moment."""
        return self._lease is None or self._candidate.leads(clock())

    def term(self) -> int:
        """Return the number of this operator's term, from 1; 0: this operator does not lead."""
        return (1 if self._lease is None else self._candidate.terms) if self.leads() else 0

    async def run(self, changed: Callable[[], None]) -> None:
        """Take part in the election until `resign`, then wait until cancelled.

        Calls ``changed`` when the leader or the term of this operator changes.
        """
        while self._lease is not None and not self._leaving:
            async with self._lock:
                if not self._leaving:
                    self._candidate = await in_thread(self._round, self._candidate, self._lease)
            self._show(changed)
            # Random pauses keep candidates from writing at once. After a failed renewal, a leader
            # also takes the short pause: little time is left to renew.
            calm = self.leads() and not self._error
            short_pause = STANDBY_READ_INTERVAL_S * random.uniform(0.5, 1.0)  # noqa: S311
            await asyncio.sleep(RENEWAL_INTERVAL_S if calm else short_pause)
        await asyncio.Event().wait()  # `run` ends the process when any task ends

    def resign(self) -> None:
        """Stop leading. This operator remains the holder of the Lease object until `release`."""
        self._leaving = self._lease is not None
        self._candidate = leadership.after_resignation(self._candidate)

    async def release(self) -> None:
        """Release the Lease object, so that another operator leads at once.

        Call this only after this operator has stopped acting.
        """
        async with self._lock:  # wait for a renewal under way
            # The result of that renewal has replaced the candidate of `resign`, so resign again.
            self._candidate = leadership.after_resignation(self._candidate)
            if self._lease is not None:
                await in_thread(self._release, self._lease)
        self._metrics.leader.set(0)

    def _round(self, candidate: Candidate, lease: Name) -> Candidate:
        """Read the Lease object, and write a new record if `leadership` says so."""
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
        """Write the Lease object. Raises ApiConflict if the object has changed since the read."""
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
        """Report which operator leads, if that has changed."""
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


def _own_name() -> str:
    """Return the name of this operator's pod. Without the chart's variable, that of the host."""
    return os.environ.get("POD_NAME") or socket.gethostname()


def lease_record(obj: Json) -> LeaseRecord:
    """Return the record of a Lease object (k8s.io/api, coordination/v1/types.go)."""
    spec = submap(obj, "spec")
    return LeaseRecord(
        version=text_at(submap(obj, "metadata"), "resourceVersion"),
        holder=text_at(spec, "holderIdentity"),
        duration=min(float(int_at(spec, "leaseDurationSeconds")), MOST_LEASE_DURATION_S),
        transitions=int_at(spec, "leaseTransitions"),
        acquired=text_at(spec, "acquireTime"),
    )


def lease_spec(record: LeaseRecord, now: datetime) -> Json:
    """Return the spec of a Lease object.

    ``now`` is the renewal time, and for a new holder also the time of the acquisition.
    """
    timestamp = now.strftime("%Y-%m-%dT%H:%M:%S.%fZ")
    return {
        "holderIdentity": record.holder,
        "leaseDurationSeconds": int(record.duration),
        "leaseTransitions": record.transitions,
        "acquireTime": record.acquired or timestamp,
        "renewTime": timestamp,
    }
