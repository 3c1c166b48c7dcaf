"""Decides which operator leads. Each operator decides by itself, from the same Lease object.

The Lease object (coordination.k8s.io/v1) names the holder. The holder renews the object every
`RENEWAL_INTERVAL_S` seconds. The rules are from k8s.io/client-go, tools/leaderelection:

- The holder acts for `RENEWAL_DEADLINE_S` seconds after a successful write, and stops unless the
  next write succeeds. The time counts from before the operator sent the write.
- An operator takes the Lease object after `LEASE_DURATION_S` seconds without a new version, or
  after the duration in the object if this is longer. The time counts from the operator's first read
  of the version, which is after the write.
- A write succeeds only if the Lease object still has the version that was read (resourceVersion).

`LEASE_DURATION_S` is longer than `RENEWAL_DEADLINE_S`, so the former leader has stopped before the
next leader acts. Each operator counts on its own clock. The timestamps in the Lease object are only
for people.
"""

import msgspec
from msgspec.structs import replace

LEASE_DURATION_S = 10.0
"""Seconds without a renewal after which another operator takes the Lease object."""
RENEWAL_DEADLINE_S = 6.0
"""Seconds that a holder acts after a renewal.

Requests under way may arrive until `LEASE_DURATION_S`.
"""
RENEWAL_INTERVAL_S = 2.0
"""Seconds between two renewals."""
STANDBY_READ_INTERVAL_S = 1.0
"""Most seconds between two reads of the Lease object by a standby."""
NEVER = float("-inf")
NO_HOLDER = "nobody"
"""Holder of a Lease object that an operator creates because there is none.

This object has to expire before an operator takes it: if a user has deleted the former Lease
object, its holder may still act.
"""


class LeaseRecord(msgspec.Struct, frozen=True):
    """A Lease object in one ``version``, its resourceVersion.

    ``holder`` is empty if the holder has released the Lease object. ``duration`` is in seconds.
    ``transitions`` is the number of changes of the holder. ``acquired`` is the timestamp that the
    holder wrote when it took the Lease object, empty before.
    """

    version: str
    holder: str = ""
    duration: float = LEASE_DURATION_S
    transitions: int = 0
    acquired: str = ""


class Candidate(msgspec.Struct, frozen=True):
    """What an operator knows about the Lease object.

    ``name`` is unique to the process: a restarted operator has another name. ``record`` is the
    Lease object at the last read, None if it does not exist. ``seen_since`` is the time of the
    first read with the same result, None before the first read. The operator leads until
    ``leads_until``. ``terms`` is the number of times that the operator has begun to lead. Times are
    in seconds of the operator's own clock.
    """

    name: str
    record: LeaseRecord | None = None
    seen_since: float | None = None
    leads_until: float = NEVER
    terms: int = 0

    def leads(self, now: float) -> bool:
        """Whether the operator may act."""
        return now < self.leads_until


def observe(candidate: Candidate, record: LeaseRecord | None, now: float) -> Candidate:
    """Return the candidate after a read of the Lease object; ``now`` is after the answer."""
    # The time of `seen_since` starts again only with a new version.
    if record == candidate.record and candidate.seen_since is not None:
        return candidate
    is_holder = record is not None and record.holder == candidate.name
    until = candidate.leads_until if is_holder else NEVER
    return replace(candidate, record=record, seen_since=now, leads_until=until)


def next_record(candidate: Candidate, now: float) -> LeaseRecord | None:
    """Return the record to write; None if another operator holds the Lease object."""
    record = candidate.record
    since = now if candidate.seen_since is None else candidate.seen_since
    if record is None:  # a user may have deleted the Lease object while an operator acts
        return LeaseRecord("", NO_HOLDER)
    if record.holder == candidate.name:
        return replace(record, duration=LEASE_DURATION_S)
    if record.holder and now - since < max(record.duration, LEASE_DURATION_S):
        return None
    return LeaseRecord(record.version, candidate.name, transitions=record.transitions + 1)


def after_write(candidate: Candidate, record: LeaseRecord, begun: float, now: float) -> Candidate:
    """Return the candidate after a write that was sent at ``begun`` and confirmed at ``now``."""
    if record.holder != candidate.name:
        return candidate
    # A renewal after `leads_until` begins a new term: the operator had stopped acting before.
    terms = candidate.terms if candidate.leads(now) else candidate.terms + 1
    return replace(candidate, leads_until=begun + RENEWAL_DEADLINE_S, terms=terms)


def after_resignation(candidate: Candidate) -> Candidate:
    """Return the candidate of an operator that has stopped acting."""
    return replace(candidate, leads_until=NEVER)


def released_record(record: LeaseRecord | None, name: str) -> LeaseRecord | None:
    """Return the record that releases the Lease object; None if ``name`` does not hold it."""
    if record is None or record.holder != name:
        return None
    # Without a holder, any operator may take the Lease object at once. The API server refuses a
    # duration of 0: ValidateLeaseSpec in k8s.io/kubernetes,
    # pkg/apis/coordination/validation/validation.go.
    return replace(record, holder="", duration=1.0)
