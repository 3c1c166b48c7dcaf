"""Which of several operators acts: decided by each of them alone, from a Lease that all see.

The Lease (coordination.k8s.io/v1) names its holder, who writes it anew every `RENEW` seconds. The
rules are those of k8s.io/client-go, tools/leaderelection:

- The operator that wrote it last and knows so acts for `DEADLINE` seconds, counted from before
  that write was sent; not a moment longer, unless the next write has succeeded.
- An operator that sees the same version of it for `DURATION` seconds takes it, counted from when
  that version was first seen, which is after it was written.
- A write goes through only if the Lease is still the version that was seen (resourceVersion).

`DURATION` is longer than `DEADLINE`, so that no operator begins before the former one has ended.
Each counts on a clock of its own; the times that stand in the Lease are for people alone.
"""

import msgspec
from msgspec.structs import replace

DURATION = 10.0
"""Seconds without a renewal after which another operator takes the Lease."""
DEADLINE = 6.0
"""Seconds for which a holder acts after a renewal. Its requests have until `DURATION` to arrive."""
RENEW = 2.0
"""Seconds between two renewals."""
LOOK = 1.0
"""Seconds at most between two looks of an operator that stands by."""
NEVER = float("-inf")
NOBODY = "nobody"
"""The holder of a Lease that was missing and is made anew: it, too, has to run out first."""


class LeaseRecord(msgspec.Struct, frozen=True):
    """A Lease as it is in one ``version``; an empty ``holder``: it was released.

    ``duration`` is what its holder promises, in seconds. ``transitions``: how often another holder
    has taken it. ``acquired``: when this one has, in its own words.
    """

    version: str
    holder: str = ""
    duration: float = DURATION
    transitions: int = 0
    acquired: str = ""


class Candidate(msgspec.Struct, frozen=True):
    """What one operator knows. ``name`` is like no other's, not even that of its former process.

    ``record`` is the Lease as it was read last, None if there is none, ``seen_since`` when that
    version was first seen, or that there is none; None: it was not read yet. It acts until
    ``leads_until``; ``terms`` are how often it has begun to.
    """

    name: str
    record: LeaseRecord | None = None
    seen_since: float | None = None
    leads_until: float = NEVER
    terms: int = 0

    def leads(self, now: float) -> bool:
        """Whether it may act."""
        return now < self.leads_until


def observe(candidate: Candidate, record: LeaseRecord | None, now: float) -> Candidate:
    """What is known after the Lease was read; ``now`` is after the answer."""
    if record == candidate.record and candidate.seen_since is not None:
        return candidate
    is_holder = record is not None and record.holder == candidate.name
    until = candidate.leads_until if is_holder else NEVER
    return replace(candidate, record=record, seen_since=now, leads_until=until)


def next_record(candidate: Candidate, now: float) -> LeaseRecord | None:
    """What is to be written over what was read; None: nothing, somebody else holds it."""
    record = candidate.record
    since = now if candidate.seen_since is None else candidate.seen_since
    if record is None:  # it may have been deleted while an operator acts
        return LeaseRecord("", NOBODY)
    if record.holder == candidate.name:
        return replace(record, duration=DURATION)
    if record.holder and now - since < max(record.duration, DURATION):
        return None
    return LeaseRecord(record.version, candidate.name, transitions=record.transitions + 1)


def after_write(candidate: Candidate, record: LeaseRecord, begun: float, now: float) -> Candidate:
    """What is known after a write that was sent at ``begun`` is known at ``now`` to be there."""
    if record.holder != candidate.name:
        return candidate
    terms = candidate.terms if candidate.leads(now) else candidate.terms + 1
    return replace(candidate, leads_until=begun + DEADLINE, terms=terms)


def after_resignation(candidate: Candidate) -> Candidate:
    """What is known by a candidate that acts no more."""
    return replace(candidate, leads_until=NEVER)


def released_record(record: LeaseRecord | None, name: str) -> LeaseRecord | None:
    """What a candidate that acts no more is to write; None if the Lease is not its own."""
    if record is None or record.holder != name:
        return None
    # Anybody may take it at once. 0 would be refused: ValidateLeaseSpec in k8s.io/kubernetes,
    # pkg/apis/coordination/validation/validation.go.
    return replace(record, holder="", duration=1.0)
