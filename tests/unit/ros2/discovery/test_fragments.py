"""Announcements in fragments of any size: rewritten like whole announcements."""

import random
import struct
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rosproxy.ros2.discovery import fragments
from rosproxy.ros2.discovery.fragments import OVERHEAD_BYTES, FragmentStores
from rosproxy.ros2.protocol.addressing import destination
from rosproxy.ros2.protocol.locators import pack_locator
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.ros2.protocol.rtps import RtpsError, Sample, SubmessageId, samples, submessages
from rosproxy.ros2.rewriting.discovery import (
    MOST_LOCATORS_OF_ALL,
    MOST_PARAMETERS_OF_ALL,
    Announcement,
    BuiltinWriter,
    DiscoveryMessage,
    read_discovery,
    rewritten,
)
from rosproxy.shared.addresses import HostPort
from tests.unit.ros2.protocol.messages import (
    PREFIX,
    data,
    message,
    parameter_list,
    payload,
    submessage,
)
from tests.unit.ros2.protocol.messages import fragment as fragment_of_any

LOCATOR = HostPort("172.30.0.5", 7411)
MAPPED = HostPort("10.0.0.1", 45001)
PORT = 45000
READER = b"reader's pre"
OTHER = b"other reader"
HEARTBEAT = submessage(0x07, 0, bytes(28))
TIME = submessage(0x09, 0, bytes(8))
fragment = partial(fragment_of_any, writer=BuiltinWriter.PUBLICATIONS)


def topic(name: str) -> tuple[int, bytes]:
    """The parameter that names a topic. The name is filled up with underscores."""
    text = name.ljust(11, "_").encode() + bytes(1)
    return Pid.TOPIC_NAME, struct.pack("<I", len(text)) + text


def described(padding: int) -> bytes:
    """The payload of an announcement: a locator in front, padding, a locator at the end."""
    return payload(
        [
            (Pid.DEFAULT_UNICAST_LOCATOR, pack_locator(LOCATOR, "<")),
            topic("rt/chatter"),
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


def whole_data(whole: bytes, sequence: int = 1) -> bytes:
    return message(data(whole, writer=BuiltinWriter.PUBLICATIONS, sequence=sequence))


def led(told: DiscoveryMessage) -> bytes:
    return rewritten(told, lambda pid, locator: MAPPED, lambda _: False)


def hidden(told: DiscoveryMessage) -> bytes:
    return rewritten(told, lambda pid, locator: MAPPED, lambda _: True)


def through(
    store: FragmentStores, datagram: bytes, rewrite: fragments.Rewrite = led
) -> list[bytes]:
    return store.rewritten(PORT, read_discovery(datagram), READER, rewrite).forwarded


def samples_of(datagrams: Iterable[bytes]) -> list[bytes]:
    """The datagrams with more than heartbeats."""
    return [datagram for datagram in datagrams if datagram != message(HEARTBEAT)]


@given(
    st.integers(0, 400),
    st.integers(fragments.SHORTEST_FRAGMENT_BYTES // 4, 175).map(lambda words: 4 * words),
    st.randoms(use_true_random=False),
)
def test_fragments_go_on_as_the_rewritten_whole(
    padding: int, size: int, dice: random.Random
) -> None:
    """In any order, and again if the writer repeats all fragments."""
    whole = described(padding)
    expected = through(FragmentStores(), whole_data(whole))
    sent = cut(whole, size)
    store = FragmentStores()
    for _ in range(2):
        dice.shuffle(sent)
        got = [forwarded for datagram in sent for forwarded in through(store, datagram)]
        assert samples_of(got) == expected
        assert got[-1] == message(HEARTBEAT)  # after the sample that the heartbeat may name
        assert store.size == 0


def test_no_fragment_goes_on() -> None:
    store = FragmentStores()
    sent = cut(described(300), 128)
    for datagram in sent[:-1]:
        assert through(store, datagram) == [message(HEARTBEAT)]
    (joined, rest) = through(store, sent[-1])
    assert [kind for kind, _, _ in submessages(joined)] == [SubmessageId.DATA]
    assert rest == message(HEARTBEAT)


def test_nothing_is_sent_if_nothing_is_left() -> None:
    store = FragmentStores()
    whole = described(300)
    info_dst = submessage(0x0E, 0, READER)
    only = message(info_dst, TIME, fragment(whole[:128], 1, 128, len(whole)))
    assert through(store, only) == []


def test_a_hidden_announcement_is_a_gap() -> None:
    store = FragmentStores()
    sent = cut(described(300), 128)
    got = [forwarded for datagram in sent for forwarded in through(store, datagram, hidden)]
    (gap,) = samples_of(got)
    assert [kind for kind, _, _ in submessages(gap)] == [SubmessageId.GAP, SubmessageId.PAD]
    assert b"chatter" not in gap


@pytest.mark.parametrize("little", [True, False])
@pytest.mark.parametrize("key", [True, False])
def test_the_first_fragment_states_destination_time_and_qos(little: bool, key: bool) -> None:
    store = FragmentStores()
    whole = described(100)
    qos = parameter_list([(0x8001, b"qos4")], little)
    flags = 0x04 if key else 0
    parts = [
        fragment(chunk, number, 128, len(whole), qos=qos, little=little)
        for number, chunk in enumerate((whole[at : at + 128] for at in range(0, 600, 128)), 1)
        if chunk
    ]
    parts = [part[:1] + bytes([part[1] | flags]) + part[2:] for part in parts]
    context = submessage(0x0E, 0, READER) + TIME
    for part in parts[:0:-1]:
        assert through(store, message(submessage(0x0E, 0, READER), part)) == []
    (joined,) = through(store, message(context, parts[0]))
    as_data = data(whole, writer=BuiltinWriter.PUBLICATIONS, qos=qos, little=little, key=key)
    assert [joined] == through(FragmentStores(), message(context, as_data))


def test_each_destination_has_its_own_fragments() -> None:
    store = FragmentStores()
    whole = described(20)
    parts = (
        fragment(whole[:128], 1, 128, len(whole)),
        fragment(whole[128:], 2, 128, len(whole)),
    )
    readers = (READER, OTHER)
    for reader in readers:
        assert through(store, message(submessage(0x0E, 0, reader), parts[0])) == []
    for reader in readers:
        (joined,) = through(store, message(submessage(0x0E, 0, reader), parts[1]))
        assert joined[20:36] == submessage(0x0E, 0, reader)
    assert through(store, message(parts[0])) == []
    (joined,) = through(store, to(bytes(12), parts[1]))
    assert destination(joined) is None


def test_what_is_in_front_of_an_announcement_is_bounded() -> None:
    whole = described(20)
    qos = parameter_list([(0x8001, bytes(fragments.MOST_BYTES_IN_FRONT))])
    part = fragment(whole[:128], 1, 128, len(whole), qos=qos)
    with pytest.raises(RtpsError, match="in front"):
        through(FragmentStores(), message(part))


def test_a_participant_does_not_announce_itself_in_fragments() -> None:
    """Cyclone DDS ignores such fragments, and would act on the joined announcement."""
    whole = described(20)
    part = fragment_of_any(whole[:128], 1, 128, len(whole), writer=BuiltinWriter.PARTICIPANTS)
    with pytest.raises(RtpsError, match="announces itself"):
        through(FragmentStores(), message(part))


def test_each_way_has_its_own_fragments() -> None:
    store = FragmentStores()
    (first, *rest) = cut(described(100), 128)
    through(store, first)
    for datagram in rest:
        passed = store.rewritten(PORT + 1, read_discovery(datagram), READER, led)
        assert passed == ([message(HEARTBEAT)], [])


def requested(question: bytes) -> list[int]:
    """The numbers of the fragments in a request."""
    (body,) = [b for kind, _, b in submessages(question) if kind == SubmessageId.NACK_FRAG]
    base, count, bits = struct.unpack_from("<III", question, body.start + 16)
    return [base + at for at in range(count) if bits >> (31 - at) & 1]


def test_a_repeated_fragment_makes_the_proxy_request_all() -> None:
    """Cyclone DDS answers a request for a sample with the first fragment alone."""
    store = FragmentStores()
    sent = cut(described(100), 128, sequence=7)
    first = read_discovery(sent[0])
    third = read_discovery(sent[2])
    assert store.rewritten(PORT, first, READER, led).questions == []
    assert store.rewritten(PORT, third, READER, led).questions == []
    _, (asked,) = store.rewritten(PORT, first, READER, led)
    assert asked[8:20] == READER
    assert destination(asked) == first.prefix
    (body,) = [body for kind, _, body in submessages(asked) if kind == SubmessageId.NACK_FRAG]
    reader, writer = struct.unpack_from(">II", asked, body.start)
    assert (reader, writer) == (0x000003C7, 0x000003C2)
    assert struct.unpack_from("<iI", asked, body.start + 8) == (0, 7)
    assert requested(asked) == [1, 2, 3, 4]  # Cyclone DDS sends these to one reader alone


def test_the_proxy_requests_missing_fragments_if_others_were_for_the_same_reader() -> None:
    store = FragmentStores()
    whole = described(100)
    parts = [fragment(whole[at : at + 128], 1 + at // 128, 128, len(whole)) for at in (0, 256)]
    sent = [read_discovery(to(READER, part)) for part in parts]
    for datagram in sent:
        assert store.rewritten(PORT, datagram, READER, led) == ([], [])
    _, (asked,) = store.rewritten(PORT, sent[0], READER, led)
    assert requested(asked) == [2, 4]


@pytest.mark.parametrize("is_for_all", [True, False])
@pytest.mark.parametrize("lost", range(4))
def test_a_reader_gets_a_sample_of_which_a_fragment_was_lost(is_for_all: bool, lost: int) -> None:
    """Cyclone DDS answers a request for a sample with the first fragment, for all or for this
    reader, and a request for fragments with fragments for this reader.
    """
    store = FragmentStores()
    whole = described(100)
    chunks = [whole[at : at + 128] for at in range(0, len(whole), 128)]
    parts = [fragment(chunk, number, 128, len(whole)) for number, chunk in enumerate(chunks, 1)]
    for index, part in enumerate(parts):
        assert index == lost or through(store, message(part)) == []
    first = message(parts[0]) if is_for_all else to(READER, parts[0])
    for _ in range(2):
        passed, questions = store.rewritten(PORT, read_discovery(first), READER, led)
        if passed or questions:
            break
    for question in questions:
        for number in requested(question):
            passed += through(store, to(READER, parts[number - 1]))
    (joined,) = passed
    assert [kind for kind, _, _ in submessages(joined)][-1] == SubmessageId.DATA


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
    """Small samples once cost nothing."""
    monkeypatch.setattr(fragments, "MOST_BYTES", 4 * OVERHEAD_BYTES)
    stores = FragmentStores()
    for sequence in range(1, 30):
        through(stores, cut(described(100), 128, sequence)[0])
    assert stores.size == sum(store.size for store in stores.by_prefix.values())
    (store,) = stores.by_prefix.values()
    assert len(store._samples) <= 3
    stores.forget(PREFIX)
    assert (stores.size, stores.by_prefix) == (0, {})


@dataclass
class Receiver:
    """Joins fragments by writer and sequence number, whatever sample these are of."""

    prefix: bytes
    announced: set[str] = field(default_factory=set)
    _parts: dict[tuple[int, int], dict[int, bytes]] = field(default_factory=dict)

    def receive(self, datagram: bytes) -> None:
        to = bytes(12)
        found = {sample.body.start: sample for sample in samples(datagram)}
        for kind, _, body in submessages(datagram):
            if kind == SubmessageId.INFO_DST:
                to = datagram[body.start : body.start + 12]
            sample = found.get(body.start)
            if sample and sample.payload and to in (bytes(12), self.prefix):
                chunk = datagram[sample.payload.start : sample.payload.end]
                self._join(sample, chunk)

    def _join(self, sample: Sample, chunk: bytes) -> None:
        if sample.fragments is None:
            self._note(chunk)
            return
        parts = self._parts.setdefault((sample.writer, sample.sequence), {})
        parts[sample.fragments.first] = chunk
        if sum(map(len, parts.values())) == sample.fragments.total:
            self._note(b"".join(parts[number] for number in sorted(parts)))

    def _note(self, whole: bytes) -> None:
        found = read_discovery(whole_data(whole))
        self.announced.update(a.topic(found.datagram) for a in found.announcements)


def split_name(first: str, second: str, size: int = 128) -> list[bytes]:
    """The two fragments of an announcement, with the end of a topic's name in the second."""
    name = (first.ljust(20, "_") + second.ljust(19, "_")).encode() + bytes(1)
    before = payload([(0x8000, bytes(size - 36))])[:-4]  # 4 header, 4 for each parameter
    whole = before + payload([(Pid.TOPIC_NAME, struct.pack("<I", len(name)) + name)])[4:]
    assert whole[:size].endswith(first.ljust(20, "_").encode())
    chunks = (whole[:size], whole[size:])
    return [fragment(chunk, number, size, len(whole)) for number, chunk in enumerate(chunks, 1)]


def announces_denied(told: Announcement, datagram: bytes) -> bool:
    return "denied" in told.topic(datagram) and "secret" in told.topic(datagram)


def judged(told: DiscoveryMessage) -> bytes:
    def is_hidden(announcement: Announcement) -> bool:
        return announces_denied(announcement, told.datagram)

    return rewritten(told, lambda pid, locator: MAPPED, is_hidden)


def to(reader: bytes, part: bytes) -> bytes:
    return message(submessage(0x0E, 0, reader), part)


def forgotten(store: FragmentStores) -> None:
    """Push all announcements out of the store."""
    for sequence in range(100, 130):
        through(store, cut(described(100), 128, sequence)[0])


def test_fragments_of_two_announcements_can_not_be_joined(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each announcement was allowed, and the joined one was denied."""
    monkeypatch.setattr(fragments, "MOST_BYTES", 4 * OVERHEAD_BYTES)
    store = FragmentStores()
    receiver = Receiver(READER)
    open_secret = split_name("open", "secret")
    denied_open = split_name("denied", "open")
    sent = [to(OTHER, open_secret[0]), to(READER, open_secret[1])]
    for datagram in sent:
        for passed in through(store, datagram, judged):
            receiver.receive(passed)
    forgotten(store)
    for datagram in (to(READER, denied_open[0]), to(OTHER, denied_open[1])):
        for passed in through(store, datagram, judged):
            receiver.receive(passed)
    assert not any("denied" in name and "secret" in name for name in receiver.announced)


ANNOUNCEMENTS = st.lists(
    st.tuples(
        st.sampled_from((("open", "secret"), ("denied", "open"), ("denied", "secret"))),
        st.sampled_from((128, 128, 256)),
        st.lists(
            st.tuples(st.integers(0, 1), st.sampled_from((b"", READER, OTHER)), st.booleans()),
            min_size=1,
            max_size=4,
        ),
        st.booleans(),
    ),
    min_size=2,
    max_size=6,
)
"""Announcements with the same sequence number: both parts of the topic's name, and the size of a
fragment. Then the fragments that are sent, in this order: the index, the destination, and whether
the fragment shares a datagram with the one before. At last, whether the store then forgets all."""


@example(
    [
        (("open", "secret"), 128, [(0, OTHER, False), (1, READER, False)], True),
        (("denied", "open"), 128, [(0, READER, False), (1, OTHER, False)], True),
    ]
)
@given(ANNOUNCEMENTS)
def test_whatever_a_receiver_can_join_was_judged(
    announcements: list[tuple[tuple[str, str], int, list[tuple[int, bytes, bool]], bool]],
) -> None:
    """Only "denied…secret…" is denied."""
    store = FragmentStores()
    receiver = Receiver(READER)
    for names, size, sent, is_forgotten in announcements:
        parts = split_name(*names, size)
        datagrams = list[bytes]()
        for index, reader, shares in sent:
            part = submessage(0x0E, 0, reader or bytes(12)) + parts[index]
            if shares and datagrams:
                datagrams[-1] += part
            else:
                datagrams.append(message(part))
        for datagram in datagrams:
            with suppress(RtpsError):
                for passed in through(store, datagram, judged):
                    receiver.receive(passed)
        if is_forgotten:
            store.clear()
    assert not any("denied" in name and "secret" in name for name in receiver.announced)


def test_nobody_pushes_out_what_others_have_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fragments, "MOST_BYTES_OF_ALL", 100 * OVERHEAD_BYTES)
    stores = FragmentStores()
    sent = cut(described(100), 128)
    assert samples_of(got for datagram in sent[:-1] for got in through(stores, datagram)) == []
    for number in range(1, 400):
        prefix = bytes([9, 9, number % 2]) + bytes(9)
        other = cut(described(100), 128, number)[0]
        through(stores, other.replace(PREFIX, prefix, 1))
        assert stores.size <= 100 * OVERHEAD_BYTES
    assert len(samples_of(through(stores, sent[-1]))) == 1


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
    whole = payload([topic("rt/chatter"), *told])
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
    assert read == []
    # Each of these can be sent again.
    for datagram in map(message, last):
        assert through(store, datagram, counted)
    assert len(read) == len(last)


@given(st.binary(max_size=200))
def test_nothing_that_is_sent_breaks_it(rest: bytes) -> None:
    store = FragmentStores()
    for start in (cut(described(100), 128)[0][:56], message()):
        try:
            through(store, start + rest)
        except RtpsError:
            continue
