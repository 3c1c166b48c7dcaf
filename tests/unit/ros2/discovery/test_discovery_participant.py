"""The discovery participant asks only for samples that it lacks."""

import struct
import tracemalloc

from hypothesis import given
from hypothesis import strategies as st

from rosproxy.ros2.discovery.discovery_participant import DiscoveryParticipant
from rosproxy.ros2.protocol.addressing import destination
from rosproxy.ros2.protocol.rtps import source_prefix, submessages
from tests.unit.ros2.protocol.messages import data, message, submessage

OWN = bytes(range(12))
PEER = b"\x01\x0f" + bytes(10)
WRITERS = 0x000003C2


def heartbeat(first: int, last: int) -> bytes:
    body = struct.pack(">II", 0, WRITERS) + struct.pack("<iIiIi", 0, first, 0, last, 1)
    return submessage(0x07, 0, body)


def asked(answer: bytes) -> tuple[int, list[int], bool]:
    """The base of an ACKNACK, the requested numbers, and the final flag."""
    *_, (kind, flags, body) = submessages(answer)
    assert (kind, source_prefix(answer), destination(answer)) == (0x06, OWN, PEER)
    high, low, bits = struct.unpack_from("<iII", answer, body.start + 8)
    words = struct.unpack_from(f"<{-(-bits // 32)}I", answer, body.start + 20)
    base = (high << 32) + low
    numbers = [base + bit for bit in range(bits) if words[bit // 32] >> (31 - bit % 32) & 1]
    return base, numbers, bool(flags & 0x02)


def test_it_asks_first_what_there_is() -> None:
    participant = DiscoveryParticipant(OWN)
    assert [asked(question) for question in participant.first_question(PEER)] == [
        (1, [], False)
    ] * 2


def test_who_has_nothing_gets_no_answer() -> None:
    participant = DiscoveryParticipant(OWN)
    assert participant.take(PEER, message(heartbeat(1, 0), prefix=PEER)) == []
    assert len(participant.first_question(PEER)) == 1  # the other writer has not been heard


@given(st.sets(st.integers(1, 40)), st.integers(1, 40))
def test_it_asks_for_what_it_lacks(got: set[int], last: int) -> None:
    participant = DiscoveryParticipant(OWN)
    for number in got:
        sample = data(b"\0\3\0\0", writer=WRITERS, sequence=number)
        assert participant.take(PEER, message(sample, prefix=PEER)) == []
    (answer,) = participant.take(PEER, message(heartbeat(1, last), prefix=PEER))
    base, missing, final = asked(answer)
    lacking = [number for number in range(1, last + 1) if number not in got]
    assert (missing, final) == (lacking, True)
    assert base == (lacking[0] if lacking else last + 1)


def test_it_asks_for_all_samples_of_a_writer_that_has_many() -> None:
    participant = DiscoveryParticipant(OWN)
    got = set[int]()
    for _ in range(10):
        (answer,) = participant.take(PEER, message(heartbeat(500, 3000), prefix=PEER))
        _, missing, _ = asked(answer)
        for number in missing:
            participant.take(
                PEER, message(data(b"\0\3\0\0", writer=WRITERS, sequence=number), prefix=PEER)
            )
        got |= {*missing}
    assert got == {*range(500, 3001)}
    (answer,) = participant.take(PEER, message(heartbeat(500, 3000), prefix=PEER))
    assert asked(answer) == (3001, [], True)


def test_a_forged_heartbeat_hides_no_samples() -> None:
    participant = DiscoveryParticipant(OWN)
    participant.take(PEER, message(heartbeat(10**9, 10**9), prefix=PEER))
    participant.take(PEER, message(heartbeat(1, 3), prefix=PEER))
    for _ in range(3):
        (answer,) = participant.take(PEER, message(heartbeat(1, 3), prefix=PEER))
        assert asked(answer) == (1, [1, 2, 3], True)


def test_little_is_remembered_of_a_writer() -> None:
    """1,000 samples of each writer took 70 MB for 384 participants, and a proxy may have 256 MB."""
    participant = DiscoveryParticipant(OWN)
    numbers = range(10**9, 10**9 + 3000, 3)
    datagrams = [
        message(data(b"\0\3\0\0", writer=WRITERS, sequence=number), prefix=PEER)
        for number in numbers
    ]
    participant.take(PEER, message(heartbeat(numbers[0] - 1, numbers[-1]), prefix=PEER))
    tracemalloc.start()
    for datagram in datagrams:
        participant.take(PEER, datagram)
    size, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert size < 10_000


def test_a_participant_that_has_gone_is_forgotten() -> None:
    participant = DiscoveryParticipant(OWN)
    sample = data(b"\0\3\0\0", writer=WRITERS, sequence=1)
    participant.take(PEER, message(sample, prefix=PEER))
    participant.forget(PEER)
    (answer,) = participant.take(PEER, message(heartbeat(1, 1), prefix=PEER))
    assert asked(answer)[1] == [1]


def test_a_writer_gets_one_answer_to_a_datagram() -> None:
    """A datagram of 8 kB with 256 heartbeats led to 256 answers of 17 kB."""
    participant = DiscoveryParticipant(OWN)
    many = message(*(heartbeat(1, number) for number in range(1, 200)), prefix=PEER)
    (answer,) = participant.take(PEER, many)
    assert asked(answer)[1] == list(range(1, 200))
