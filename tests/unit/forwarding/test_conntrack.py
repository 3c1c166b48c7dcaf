"""What ``conntrack -L`` prints, as conntrack 1.4.7 printed it."""

from hypothesis import given
from hypothesis import strategies as st

from rosproxy.forwarding.kernel import conntrack
from rosproxy.forwarding.kernel.connection_table import Marks
from rosproxy.forwarding.kernel.conntrack import Flow, Watch
from rosproxy.net.addresses import HostPort

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
NODE = HostPort("172.30.1.11", 38851)


def marked(line: str, mark: int = MARK) -> str:
    return f"{line}mark={mark} use=1"


def test_connections_are_read() -> None:
    text = "\n".join([marked(OPEN), marked(WAITING), marked(SIX), ""])
    first, second, third = conntrack.read(text, MARKS)
    assert first == Flow("ESTABLISHED", HostPort("10.77.0.2", 53724), 45050, NODE)
    assert second.state == "SYN_SENT"
    assert third.peer.host == "fd00:1::2"
    assert third.node == HostPort("fd00:2::11", 3)


def test_what_is_of_others_or_makes_no_sense_is_left_out() -> None:
    lines = [
        marked(OPEN, 0),
        marked(OPEN, Marks(11312).of(45050)),
        OPEN,
        marked(OPEN).replace("tcp ", "udp "),
        marked(OPEN).replace("sport=53724", "sport=x"),
        marked(OPEN).partition(" src=172.30.1.11")[0] + f" mark={MARK}",
        "conntrack v1.4.7 (conntrack-tools): 5 flow entries have been shown.",
        "",
    ]
    assert conntrack.read("\n".join(lines), MARKS) == []


@given(st.text())
def test_nothing_breaks_it(text: str) -> None:
    assert conntrack.read(text, MARKS) == []


@given(st.lists(st.sampled_from(marked(OPEN).split())))
def test_no_selection_of_words_breaks_it(words: list[str]) -> None:
    for flow in conntrack.read(" ".join(words), MARKS):
        assert flow.port == 45050


def flow(state: str, peer: str = "10.77.0.2", sport: int = 1, node: str = NODE.host) -> Flow:
    return Flow(state, HostPort(peer, sport), 45050, HostPort(node, 1))


def test_open_connections_are_counted_by_peer() -> None:
    flows = [
        flow("ESTABLISHED", sport=1),
        flow("ESTABLISHED", sport=2),
        flow("ESTABLISHED", "10.77.0.3"),
        flow("TIME_WAIT", sport=3),
        flow("SYN_SENT", sport=4),
        flow("ESTABLISHED", sport=5, node="172.30.1.99"),
    ]
    assert conntrack.peers(flows, NODE.host) == {"10.77.0.2": 2, "10.77.0.3": 1}
    assert conntrack.peers([], NODE.host) == {}


def test_who_is_not_answered_is_told_after_a_while() -> None:
    watch, waiting, other = Watch(3.0), flow("SYN_SENT"), flow("SYN_SENT", sport=2)
    assert watch.look([waiting, flow("ESTABLISHED", sport=3)], 10.0) == []
    assert watch.look([waiting, other], 12.9) == []
    assert watch.look([waiting, other], 13.0) == [waiting]
    assert watch.look([other], 15.9) == [other]


def test_who_was_answered_meanwhile_begins_anew() -> None:
    watch, waiting = Watch(3.0), flow("SYN_SENT")
    assert watch.look([waiting], 10.0) == []
    assert watch.look([], 12.0) == []
    assert watch.look([waiting], 14.0) == []
    assert watch.look([waiting], 17.0) == [waiting]
