"""Never two operators act at once, whatever is slow, stands still or gets lost."""

from dataclasses import dataclass, field

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy_operator.kubernetes.planner.leadership import (
    LEASE_DURATION_S,
    NO_HOLDER,
    RENEWAL_DEADLINE_S,
    Candidate,
    LeaseRecord,
    after_resignation,
    after_write,
    next_record,
    observe,
    released_record,
)

OTHER = LeaseRecord("7", "b", transitions=3, acquired="then")


MINE = LeaseRecord("", "a")


def test_a_missing_lease_is_made_and_has_to_expire_first() -> None:
    """The former holder may still act."""
    candidate = observe(Candidate("a"), None, 5.0)
    made = next_record(candidate, 5.0)
    assert made == LeaseRecord("", NO_HOLDER)
    assert not after_write(candidate, made, 5.0, 5.0).leads(5.0)
    candidate = observe(candidate, LeaseRecord("1", NO_HOLDER), 6.0)
    assert next_record(candidate, 6.0 + LEASE_DURATION_S - 0.1) is None
    assert next_record(candidate, 6.0 + LEASE_DURATION_S) == LeaseRecord("1", "a", transitions=1)


def test_one_acts_for_a_time_that_begins_before_its_write() -> None:
    candidate = after_write(Candidate("a"), MINE, 15.0, 16.0)
    assert (
        candidate.leads(15.0 + RENEWAL_DEADLINE_S - 0.1),
        candidate.leads(15.0 + RENEWAL_DEADLINE_S),
    ) == (
        True,
        False,
    )


def test_one_that_nobody_holds_is_taken_at_once() -> None:
    assert next_record(observe(Candidate("a"), LeaseRecord("1"), 5.0), 5.0) is not None


def test_one_that_is_held_is_taken_once_it_has_been_the_same_for_long() -> None:
    candidate = observe(Candidate("a"), OTHER, 100.0)
    candidate = observe(candidate, OTHER, 105.0)
    assert next_record(candidate, 100.0 + LEASE_DURATION_S - 0.1) is None
    assert next_record(candidate, 100.0 + LEASE_DURATION_S) == LeaseRecord("7", "a", transitions=4)


def test_a_renewal_begins_the_time_anew() -> None:
    candidate = observe(Candidate("a"), OTHER, 100.0)
    candidate = observe(candidate, LeaseRecord("8", "b"), 109.0)
    assert next_record(candidate, 109.0 + LEASE_DURATION_S - 0.1) is None


def test_a_holder_that_promises_longer_is_waited_for() -> None:
    """Another release may have other times."""
    candidate = observe(Candidate("a"), LeaseRecord("7", "b", duration=30.0), 100.0)
    assert next_record(candidate, 129.0) is None
    assert next_record(candidate, 130.0) is not None


def test_one_that_was_released_is_taken_at_once() -> None:
    record = released_record(LeaseRecord("7", "b"), "b")
    assert record is not None
    assert record.holder == ""
    assert next_record(observe(Candidate("a"), record, 100.0), 100.0) is not None


def test_only_the_holder_releases() -> None:
    assert released_record(OTHER, "a") is None
    assert released_record(None, "a") is None


def test_who_sees_another_holder_leads_no_more() -> None:
    candidate = after_write(observe(Candidate("a"), LeaseRecord("6"), 99.0), MINE, 100.0, 100.0)
    assert observe(candidate, LeaseRecord("8", "a"), 101.0).leads(101.0)
    assert not observe(candidate, OTHER, 101.0).leads(101.0)
    assert not observe(candidate, None, 101.0).leads(101.0)


def test_terms_are_counted() -> None:
    candidate = after_write(Candidate("a"), MINE, 100.0, 100.0)
    candidate = after_write(candidate, MINE, 102.0, 102.0)
    assert candidate.terms == 1
    assert after_write(candidate, MINE, 120.0, 120.0).terms == 2
    assert after_resignation(candidate).terms == 1


@dataclass
class Store:
    """The API server: a single Lease, which is written only over the version that was read."""

    record: LeaseRecord | None
    version: int = 0

    def write(self, record: LeaseRecord) -> bool:
        if record.version != (self.record.version if self.record else ""):
            return False
        self.version += 1
        self.record = LeaseRecord(
            str(self.version), record.holder, record.duration, record.transitions
        )
        return True


@dataclass
class Operator:
    """A candidate with its own clock, and perhaps a pending request."""

    candidate: Candidate
    ahead: float
    read: LeaseRecord | None = None
    writing: tuple[LeaseRecord, float] | None = None
    answered: bool | None = None
    step: int = field(default=0)

    def go(self, store: Store, now: float, lost: bool) -> None:
        """Do the next part of a round. Any time may pass between two parts."""
        own = now + self.ahead
        self.step = (self.step + 1) % 4
        if self.step == 1:
            self.read = store.record
        elif self.step == 2:
            self.candidate = observe(self.candidate, self.read, own)
            record = next_record(self.candidate, own)
            self.writing = (record, own) if record is not None else None
        elif self.step == 3:
            self.answered = None
            if self.writing is not None:
                done = store.write(self.writing[0])
                self.answered = done and not lost  # written, but the answer is lost
        elif self.writing is not None and self.answered:
            self.candidate = after_write(self.candidate, *self.writing, own)

    def round(self, store: Store, now: float) -> None:
        """End what is under way, then do a whole round at once."""
        for _ in range(4 + -self.step % 4):
            self.go(store, now, lost=False)

    def stop(self, store: Store) -> None:
        """Stop acting, then release the Lease."""
        self.candidate = after_resignation(self.candidate)
        if record := released_record(store.record, self.candidate.name):
            store.write(record)
        # the operator starts again
        self.candidate = Candidate(f"{self.candidate.name}'")
        self.step = 0


STEPS = st.lists(
    st.tuples(
        st.integers(0, 2),
        st.sampled_from([0.0, 0.0, 0.0, 1.0, 3.0, 5.0, 10.0, 10.1]),
        st.sampled_from(["round"] * 16 + ["go"] * 8 + ["lost", "stop", "delete"]),
    ),
    min_size=20,
    max_size=60,
)
AHEAD = st.lists(st.floats(-1000.0, 1000.0), min_size=3, max_size=3)


@given(STEPS, AHEAD, st.booleans())
def test_never_two_at_once(
    steps: list[tuple[int, float, str]], ahead: list[float], made: bool
) -> None:
    """Requests take any time, operators stand still, answers get lost, clocks differ, and a user
    deletes the Lease.
    """
    store = Store(LeaseRecord("0") if made else None)
    now = 0.0
    operators = [Operator(Candidate(name), own) for name, own in zip("abc", ahead, strict=True)]
    for index, passed, action in steps:
        now += passed
        leading(operators, now)
        if action == "stop":
            operators[index].stop(store)
        elif action == "delete":
            store.record = None
        elif action == "round":
            operators[index].round(store, now)
        else:
            operators[index].go(store, now, lost=action == "lost")
        leading(operators, now)


def leading(operators: list[Operator], now: float) -> list[str]:
    """The leading operators: at most one."""
    leaders = [
        operator.candidate.name
        for operator in operators
        if operator.candidate.leads(now + operator.ahead)
    ]
    assert len(leaders) <= 1, leaders
    return leaders


@pytest.mark.parametrize("stopped", [True, False], ids=["stopped", "killed"])
def test_another_operator_takes_over(stopped: bool) -> None:
    """Candidates look each second: one leads a second after a stop, 12 s after a kill."""
    store = Store(LeaseRecord("0"))
    now = 0.0
    first = Operator(Candidate("a"), 0.0)
    second = Operator(Candidate("b"), 50.0)
    for operator in (first, second):
        operator.round(store, now)
    assert leading([first, second], now) == ["a"]
    if stopped:
        first.stop(store)
    end = now + (1.0 if stopped else 12.0)
    while now < end:
        now += 1.0
        second.round(store, now)
    assert leading([first, second], now) == ["b"]
