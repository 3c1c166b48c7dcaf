"""The output of ``conntrack -L``, recorded with conntrack 1.4.7."""

from hypothesis import given
from hypothesis import strategies as st

from rosproxy.forwarding.kernel.connection_table import Marks
from rosproxy.forwarding.kernel.conntrack import (
    MOST_PEERS,
    MOST_WAITING,
    OTHERS,
    Flow,
    Survey,
    Watch,
)
from rosproxy.shared.addresses import HostPort

MARKS = Marks(11311)
MARK = MARKS.of(45050)
OPEN = (
    "tcp      6 431999 ESTABLISHED src=10.77.0.2 dst=172.30.1.2 sport=53724 dport=45050 "
    "src=172.30.1.11 dst=172.30.1.2 sport=38851 dport=53724 [ASSURED] "
)
WAITING = (
    "tcp      6 118 SYN_SENT src=10.77.0.2 dst=172.30.1.2 sport=53725 dport=45050 [UNREPLIED] "
    "src=172.30.1.11 dst=172.30.1.2 sport=38851 dport=53725 "
)
SIX = (
    "tcp      6 431998 ESTABLISHED src=fd00:1::2 dst=fd00:2::2 sport=1 dport=45050 "
    "src=fd00:2::11 dst=fd00:2::2 sport=3 dport=1 [ASSURED] "
)
COUNTED = (
    "tcp      6 431999 ESTABLISHED src=10.77.0.3 dst=172.30.1.2 sport=1 dport=45050 packets=4 "
    "bytes=300 src=172.30.1.11 dst=172.30.1.2 sport=38851 dport=1 packets=3 bytes=200 [ASSURED] "
)
NODE = HostPort("172.30.1.11", 38851)


def marked(line: str, mark: int = MARK) -> str:
    return f"{line}mark={mark} use=1\n"


def survey(*pieces: str) -> Survey:
    made = Survey(MARKS)
    for piece in pieces:
        made.add(piece)
    return made


def test_connections_are_read_piece_by_piece() -> None:
    read = survey(marked(OPEN) + marked(WAITING), marked(SIX) + marked(COUNTED))
    assert read.open == {
        (45050, NODE.host): {"10.77.0.2": 1, "10.77.0.3": 1},
        (45050, "fd00:2::11"): {"fd00:1::2": 1},
    }
    assert read.waiting == [Flow(HostPort("10.77.0.2", 53725), 45050, NODE)]


def test_what_is_of_others_or_makes_no_sense_is_left_out() -> None:
    lines = [
        marked(OPEN, 0),
        marked(OPEN, Marks(11312).of(45050)),
        OPEN + "\n",
        marked(OPEN).replace("tcp ", "udp "),
        marked(OPEN).replace("sport=53724", "sport=x"),
        marked(OPEN).replace("ESTABLISHED", "TIME_WAIT"),
        marked(OPEN).partition(" src=172.30.1.11")[0] + f" mark={MARK}\n",
        "conntrack v1.4.7 (conntrack-tools): 5 flow entries have been shown.\n",
        "\n",
    ]
    read = survey("".join(lines))
    assert (read.open, read.waiting) == ({}, [])


@given(st.text())
def test_nothing_breaks_it(text: str) -> None:
    read = survey(text)
    assert (read.open, read.waiting) == ({}, [])


@given(st.lists(st.sampled_from(marked(OPEN).split())))
def test_no_selection_of_words_breaks_it(words: list[str]) -> None:
    assert {port for port, _ in survey(" ".join(words)).open} <= {45050}


def test_connections_are_counted_by_peer() -> None:
    read = survey(marked(OPEN) * 2, marked(OPEN))
    assert read.open == {(45050, NODE.host): {"10.77.0.2": 3}}


def test_a_flood_from_many_addresses_keeps_little() -> None:
    sources = [f"10.1.{number // 250}.{number % 250}" for number in range(1000)]
    lines = "".join(
        marked(line.replace("src=10.77.0.2", f"src={source}"))
        for source in sources
        for line in (OPEN, WAITING)
    )
    read = survey(lines, lines)
    (counts,) = read.open.values()
    assert len(counts) == MOST_PEERS + 1
    assert counts[OTHERS] == 2 * (1000 - MOST_PEERS)
    assert sum(counts.values()) == 2000
    assert len(read.waiting) == MOST_WAITING


def flow(peer_port: int) -> Flow:
    return Flow(HostPort("10.77.0.2", peer_port), 45050, NODE)


def test_who_is_not_answered_is_told_after_a_while() -> None:
    watch = Watch(3.0)
    waiting = flow(1)
    other = flow(2)
    assert watch.look([waiting], 10.0) == []
    assert watch.look([waiting, other], 12.9) == []
    assert watch.look([waiting, other], 13.0) == [waiting]
    assert watch.look([other], 15.9) == [other]


def test_who_was_answered_meanwhile_begins_anew() -> None:
    watch = Watch(3.0)
    waiting = flow(1)
    assert watch.look([waiting], 10.0) == []
    assert watch.look([], 12.0) == []
    assert watch.look([waiting], 14.0) == []
    assert watch.look([waiting], 17.0) == [waiting]
