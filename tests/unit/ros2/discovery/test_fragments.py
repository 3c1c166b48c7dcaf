"""Announcements in fragments of any size: rewritten like whole announcements."""

import random
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.net.addresses import HostPort
from rosproxy.ros2.discovery import fragments
from rosproxy.ros2.discovery.fragments import OVERHEAD_BYTES, FragmentStore, FragmentStores
from rosproxy.ros2.protocol.addressing import destination
from rosproxy.ros2.protocol.locators import pack_locator
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.protocol.rtps import RtpsError, SubmessageId, submessages
from rosproxy.ros2.rewriting.discovery import (
    MOST_LOCATORS_OF_ALL,
    MOST_PARAMETERS_OF_ALL,
    DiscoveryMessage,
    read_discovery,
    rewritten,
)
from tests.unit.ros2.protocol.messages import PREFIX, data, fragment, message, payload, submessage

LOCATOR = HostPort("172.30.0.5", 7411)
MAPPED = HostPort("10.0.0.1", 45001)
PORT = 45000
READER = b"reader's pre"
HEARTBEAT = submessage(0x07, 0, bytes(28))


def described(padding: int) -> bytes:
    """The payload of an announcement: a locator in front, padding, a locator at the end."""
    return payload(
        [
            (Pid.DEFAULT_UNICAST_LOCATOR, pack_locator(LOCATOR, "<")),
            (0x8000, bytes(range(4)) * padding),
            (Pid.METATRAFFIC_UNICAST_LOCATOR, pack_locator(LOCATOR, "<")),
        ]
    )


def cut(whole: bytes, size: int, sequence: int = 1) -> list[bytes]:
    """A datagram for each fragment, each followed by a heartbeat."""
    chunks = [whole[at : at + size] for at in range(0, len(whole), size)]
    return [
        message(fragment(chunk, number, size, len(whole), sequence=sequence), HEARTBEAT)
        for number, chunk in enumerate(chunks, 1)
    ]


def led(told: DiscoveryMessage) -> bytes:
    return rewritten(told, lambda pid, locator: MAPPED, lambda _: False)


def hidden(told: DiscoveryMessage) -> bytes:
    return rewritten(told, lambda pid, locator: MAPPED, lambda _: True)


def through(
    store: FragmentStores, datagram: bytes, rewrite: fragments.Rewrite = led
) -> list[bytes]:
    return store.rewritten(PORT, read_discovery(datagram), READER, rewrite).forwarded


@given(
    st.integers(0, 400),
    st.integers(fragments.SHORTEST_FRAGMENT_BYTES // 4, 175).map(lambda words: 4 * words),
    st.randoms(use_true_random=False),
    st.booleans(),
)
def test_fragments_carry_the_rewritten_whole(
    padding: int, size: int, dice: random.Random, twice: bool
) -> None:
    """In any order, once or twice."""
    whole = described(padding)
    (expected,) = through(FragmentStores(), message(data(whole)))
    after = expected[-len(whole) :]
    sent = cut(whole, size)
    order = sent * (1 + twice)
    dice.shuffle(order)
    store = FragmentStores()
    got = [forwarded for datagram in order for forwarded in through(store, datagram)]
    assert sorted(got) == sorted(cut(after, size) * (1 + twice))
    again = dice.choice(range(len(sent)))
    assert through(store, sent[again]) == [cut(after, size)[again]]


def test_nothing_goes_on_before_all_is_there() -> None:
    store = FragmentStores()
    sent = cut(described(300), 128)
    assert [through(store, datagram) for datagram in sent[:-1]] == [[]] * (len(sent) - 1)
    assert len(through(store, sent[-1])) == len(sent)


def test_what_is_hidden_is_a_gap_in_each_datagram() -> None:
    store = FragmentStores()
    sent = cut(described(300), 128)
    got = [forwarded for datagram in sent for forwarded in through(store, datagram, hidden)]
    for before, after in zip(sent, got, strict=True):
        kinds = [kind for kind, _, _ in submessages(after)]
        assert kinds == [SubmessageId.GAP, SubmessageId.PAD, SubmessageId.HEARTBEAT]
        assert len(after) == len(before)
        assert before[24 + 32 : -32] not in after


def test_each_way_has_its_own_fragments() -> None:
    store = FragmentStores()
    (first, *rest) = cut(described(100), 128)
    through(store, first)
    for datagram in rest:
        assert store.rewritten(PORT + 1, read_discovery(datagram), READER, led) == ([], [])


def test_a_repeated_fragment_makes_the_proxy_ask_for_the_others() -> None:
    """Cyclone DDS answers a request for a sample with the first fragment alone."""
    store = FragmentStores()
    sent = cut(described(100), 128, sequence=7)
    first = read_discovery(sent[0])
    third = read_discovery(sent[2])
    assert store.rewritten(PORT, first, READER, led) == ([], [])
    assert store.rewritten(PORT, third, READER, led) == ([], [])
    _, (asked,) = store.rewritten(PORT, first, READER, led)
    assert asked[8:20] == READER
    assert destination(asked) == first.prefix
    (body,) = [body for kind, _, body in submessages(asked) if kind == SubmessageId.NACK_FRAG]
    reader, writer = struct.unpack_from(">II", asked, body.start)
    assert (reader, writer) == (0x000100C7, 0x000100C2)
    assert struct.unpack_from("<iIIII", asked, body.start + 8) == (0, 7, 2, 3, 0b101 << 29)


@pytest.mark.parametrize(
    ("first", "size", "total", "length"),
    [
        (0, 100, 200, 100),
        (3, 100, 200, 100),
        (1, 0, 200, 1),
        (1, 100, 70_000, 100),
        (1, 100, 99, 9),
    ],
)
def test_fragments_that_can_not_be_are_refused(
    first: int, size: int, total: int, length: int
) -> None:
    body = struct.pack("<HH", 0, 28) + bytes(4) + 0x000003C2.to_bytes(4, "big")
    body += struct.pack("<iIIHHI", 0, 1, first, 1, size, total) + bytes(length)
    with pytest.raises(RtpsError):
        through(FragmentStores(), message(submessage(0x16, 0, body)))


def test_an_announcement_can_not_change_its_size() -> None:
    store = FragmentStores()
    through(store, cut(described(100), 128)[0])
    with pytest.raises(RtpsError):
        through(store, cut(described(101), 128)[0])


def test_so_much_is_remembered_of_a_participant_and_no_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Waiting datagrams and their parsed content once took 600 MB, and small samples cost
    nothing.
    """
    monkeypatch.setattr(fragments, "MOST_BYTES", 4 * OVERHEAD_BYTES)
    stores = FragmentStores()
    for sequence in range(1, 30):
        through(stores, cut(described(100), 128, sequence)[0])
    assert stores.size == sum(store.size for store in stores.by_prefix.values())
    (store,) = stores.by_prefix.values()
    assert len(store._samples) <= 3
    assert len(store._waiting_datagrams) <= 3
    assert set().union(*store._waiting_by_key.values()) == store._waiting_datagrams.keys()
    stores.forget(PREFIX)
    assert (stores.size, stores.by_prefix) == (0, {})


def test_a_whole_announcement_wakes_its_own_datagrams_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """All that waited were walked through for each that became whole."""
    stores = FragmentStores()
    is_whole = FragmentStore._is_whole
    looks = list[object]()

    def counted(store: FragmentStore, datagram: fragments._WaitingDatagram) -> bool:
        looks.append(datagram)
        return is_whole(store, datagram)

    monkeypatch.setattr(FragmentStore, "_is_whole", counted)
    for sequence in range(1, 201):
        assert through(stores, cut(described(20), 128, sequence)[0]) == []
    looks.clear()
    for sequence in range(201, 301):
        first, last = cut(described(20), 128, sequence)
        assert through(stores, first) == []
        assert len(through(stores, last)) == 2
    assert len(looks) <= 100 * 3
    assert len(through(stores, cut(described(20), 128, 7)[1])) == 2


def test_a_datagram_waits_for_all_that_it_has_a_part_of() -> None:
    size = 128
    store = FragmentStores()
    whole = described(20)
    chunks = [whole[at : at + size] for at in range(0, len(whole), size)]
    parts = {
        (sequence, number): fragment(chunk, number, size, len(whole), sequence=sequence)
        for sequence in (1, 2)
        for number, chunk in enumerate(chunks, 1)
    }
    assert len(chunks) == 2
    both = message(parts[1, 1], parts[2, 1])
    assert through(store, both) == []
    assert len(through(store, message(parts[1, 2]))) == 1
    assert [len(datagram) for datagram in through(store, message(parts[2, 2]))] == [
        len(both),
        len(message(parts[2, 2])),
    ]
    (of_sender,) = store.by_prefix.values()
    assert (of_sender._waiting_datagrams, of_sender._waiting_by_key, of_sender._waiting_bytes) == (
        {},
        {},
        0,
    )


def test_nobody_pushes_out_what_others_have_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fragments, "MOST_BYTES_OF_ALL", 100 * OVERHEAD_BYTES)
    stores = FragmentStores()
    sent = cut(described(100), 128)
    assert [through(stores, datagram) for datagram in sent[:-1]] == [[]] * (len(sent) - 1)
    for number in range(1, 400):
        prefix = bytes([9, 9, number % 2]) + bytes(9)
        other = cut(described(100), 128, number)[0]
        through(stores, other.replace(PREFIX, prefix, 1))
        assert stores.size <= 100 * OVERHEAD_BYTES
    assert len(through(stores, sent[-1])) == len(sent)


def test_a_datagram_has_so_many_fragments_and_no_more() -> None:
    data_frag = fragment(bytes(128), 1, 128, 300)
    with pytest.raises(RtpsError):
        through(FragmentStores(), message(*[data_frag] * (fragments.MOST_FRAGMENTS + 1)))


@pytest.mark.parametrize(
    ("told", "count"),
    [
        ([(0x1234, b"")] * 200, MOST_PARAMETERS_OF_ALL),
        ([(Pid.UNICAST_LOCATOR, bytes(24))] * 30, MOST_LOCATORS_OF_ALL),
    ],
)
def test_what_a_datagram_completes_has_so_many_parts_and_no_more(
    told: list[tuple[int, bytes]], count: int
) -> None:
    """64 last fragments of announcements with 227 parameters took 59 ms, in 4.4 kB."""
    store = FragmentStores()
    whole = payload(told)
    first = len(whole) // 128 * 128
    numbers = range(1, count // len(told) + 2)
    assert len(numbers) <= fragments.MOST_FRAGMENTS
    assert len(numbers) * len(whole) <= fragments.LONGEST_ANNOUNCEMENT_BYTES
    for number in numbers:
        begun = fragment(whole[:first], 1, 128, len(whole), sequence=number)
        assert not through(store, message(begun))
    last = [
        fragment(whole[first:], first // 128 + 1, 128, len(whole), sequence=number)
        for number in numbers
    ]
    with pytest.raises(RtpsError, match="more than"):
        through(store, message(*last))


def test_all_announcements_that_a_datagram_completes_count_as_one() -> None:
    """64 last fragments of 14 kB each, in a datagram of 2.6 kB, took 0.4 s in one step."""
    store = FragmentStores()
    whole = described(1500)
    size = len(whole) - 4
    most = fragments.LONGEST_ANNOUNCEMENT_BYTES // len(whole)
    numbers = range(1, most + 2)
    for number in numbers:
        assert not through(
            store, message(fragment(whole[:size], 1, size, len(whole), sequence=number))
        )
    last = [fragment(whole[size:], 2, size, len(whole), sequence=number) for number in numbers]
    read = list[DiscoveryMessage]()

    def counted(told: DiscoveryMessage) -> bytes:
        read.extend([told] if told.announcements else [])
        return led(told)

    with pytest.raises(RtpsError, match="completes"):
        through(store, message(*last), counted)
    assert len(read) == most
    # The rest can be sent again.
    assert through(store, message(last[-1]), counted)
    assert len(read) == most + 1


@given(st.binary(max_size=200))
def test_nothing_that_is_sent_breaks_it(rest: bytes) -> None:
    store = FragmentStores()
    for start in (cut(described(100), 128)[0][:56], message()):
        try:
            through(store, start + rest)
        except RtpsError:
            continue
