"""Which of several operators acts: decided by each of them alone, from a Lease that all see.

The Lease (coordination.k8s.io/v1) names its holder, who writes it anew every `RENEW` seconds. The
rules are those of k8s.io/client-go, tools/leaderelection:

- Whoever wrote it last and knows so acts for `DEADLINE` seconds, counted from before that write
  was sent; not a moment longer, unless the next write has succeeded.
- Whoever sees the same version of it for `DURATION` seconds takes it, counted from when that
  version was first seen, which is after it was written.
- A write goes through only if the Lease is still the version that was seen (resourceVersion).

`DURATION` is longer than `DEADLINE`, so that nobody begins before the one before has ended. Each
counts on a clock of its own; the times that stand in the Lease are for people alone.
"""

import msgspec
from msgspec.structs import replace

DURATION = 10.0
"""Seconds without a renewal after which another operator takes the Lease."""
DEADLINE = 6.0
"""Seconds for which one acts after a renewal. Requests that it has sent have the rest to arrive."""
RENEW = 2.0
"""Seconds between two renewals."""
LOOK = 1.0
"""Seconds at most between two looks of one that stands by."""
NEVER = float("-inf")
NOBODY = "nobody"
"""The holder of a Lease that was missing and is made anew: it, too, has to run out first."""


class LeaseRecord(msgspec.Struct, frozen=True):
    """A Lease as it is in one ``version``; an empty ``holder``: it was released.

    ``duration`` is what its holder promises, in seconds. ``transitions``: how often another one has
    taken it. ``acquired``: when the holder has, in its own words.
    """

    version: str
    holder: str = ""
    duration: float = DURATION
    transitions: int = 0
    acquired: str = ""


class Candidate(msgspec.Struct, frozen=True):
    """What one operator knows. ``name`` is like no other's, not even that of its former process.

    ``seen`` is the Lease as it was read last, None if there is none, ``since`` when that version
    was first seen, or that there is none; None: it was not read yet. It acts until ``until``;
    ``terms`` are how often it has begun to.
    """

    name: str
    seen: LeaseRecord | None = None
    since: float | None = None
    until: float = NEVER
    terms: int = 0

    def leads(self, now: float) -> bool:
        """Whether it may act."""
        return now < self.until


def observe(one: Candidate, seen: LeaseRecord | None, now: float) -> Candidate:
    """What is known after the Lease was read; ``now`` is after the answer."""
    if seen == one.seen and one.since is not None:
        return one
    kept = seen is not None and seen.holder == one.name
    return replace(one, seen=seen, since=now, until=one.until if kept else NEVER)


def wanted(one: Candidate, now: float) -> LeaseRecord | None:
    """What is to be written over what was read; None: nothing, somebody else holds it."""
    seen, since = one.seen, now if one.since is None else one.since
    if seen is None:  # it may have been taken away from one that acts
        return LeaseRecord("", NOBODY)
    if seen.holder == one.name:
        return replace(seen, duration=DURATION)
    if seen.holder and now - since < max(seen.duration, DURATION):
        return None
    return LeaseRecord(seen.version, one.name, transitions=seen.transitions + 1)


def wrote(one: Candidate, record: LeaseRecord, begun: float, now: float) -> Candidate:
    """What is known after a write that was sent at ``begun`` is known at ``now`` to be there."""
    if record.holder != one.name:
        return one
    terms = one.terms if one.leads(now) else one.terms + 1
    return replace(one, until=begun + DEADLINE, terms=terms)


def resigned(one: Candidate) -> Candidate:
    """What is known by one that acts no more."""
    return replace(one, until=NEVER)


def released(seen: LeaseRecord | None, name: str) -> LeaseRecord | None:
    """What is to be written by one that acts no more; None if the Lease is not its own."""
    if seen is None or seen.holder != name:
        return None
    return replace(seen, holder="", duration=1.0)
