"""What ``conntrack -L`` prints: one connection a line, as the kernel tracks it.

    tcp 6 431999 ESTABLISHED src=A dst=B sport=1 dport=2 src=C dst=D sport=3 dport=4 [ASSURED]
    mark=5 use=1

The first four addresses are of the connection as it came, the others of what answers it. Lines of
UDP have no state.
"""

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import msgspec

from rosproxy.forwarding.kernel.decisions import Forwards
from rosproxy.forwarding.kernel.nft import Marks, Transport
from rosproxy.net.addresses import HostPort


class Flow(msgspec.Struct, frozen=True):
    """A TCP connection that the kernel forwards: from ``peer`` through ``port`` to ``node``.

    Its ``state`` is ESTABLISHED while both sides have said yes and none has ended it, and SYN_SENT
    while the node has not answered yet.
    """

    state: str
    peer: HostPort
    port: int
    node: HostPort


def read(text: str, marks: Marks) -> list[Flow]:
    """The connections of one proxy, by its marks. Lines that make no sense are left out."""
    found = ((one, marks.port(one.mark)) for one in _entries(text) if one.transport == "tcp")
    return [Flow(one.state, one.peer, port, one.answers) for one, port in found if port is not None]


class Astray(NamedTuple):
    """Where datagrams arrive that do not go where they ought to.

    ``unled``: at these ports somebody is not forwarded who had begun to send before; some may be of
    another machine. ``misled`` are ports that still lead somebody where they led formerly.
    """

    unled: set[HostPort]
    misled: set[int]


def astray(text: str, forwards: Forwards, marks: Marks) -> Astray:
    """The ports whose datagrams the kernel leads as it did when their first one came.

    It has noted for each sender where that one went, and asks no rule again, as long as no pause
    between them is longer than half a minute.
    """
    found = Astray(set(), set())
    for one in _entries(text):
        port = marks.port(one.mark)
        if one.transport != Transport.UDP:
            continue
        if port is not None and forwards.get(port) != one.answers:
            found.misled.add(port)
        elif port is None and one.reached.port in forwards and one.answers == one.reached:
            found.unled.add(one.reached)
    return found


def peers(flows: Iterable[Flow], address: str) -> dict[str, int]:
    """How many open connections each peer has with the node at an address; empty: at any."""
    there = (flow for flow in flows if address in ("", flow.node.host))
    return dict(Counter(flow.peer.host for flow in there if flow.state == "ESTABLISHED"))


class Watch:
    """Which connections nobody has answered for ``patience`` seconds."""

    def __init__(self, patience: float) -> None:
        self._patience = patience
        self._since: dict[Flow, float] = {}

    def look(self, flows: Sequence[Flow], now: float) -> list[Flow]:
        """Those among the connections that there are at a time."""
        waiting = (flow for flow in flows if flow.state == "SYN_SENT")
        self._since = {flow: self._since.get(flow, now) for flow in waiting}
        return [flow for flow, since in self._since.items() if now - since >= self._patience]


class _Entry(NamedTuple):
    """A line: who sends where, and who answers."""

    transport: str
    state: str
    peer: HostPort
    reached: HostPort
    answers: HostPort
    mark: int


def _entries(text: str) -> Iterator[_Entry]:
    """The lines that make sense."""
    return filter(None, (_entry(line.split()) for line in text.splitlines()))


def _entry(words: list[str]) -> _Entry | None:
    said: defaultdict[str, list[str]] = defaultdict(list)
    for key, equals, value in (word.partition("=") for word in words):
        if equals:
            said[key].append(value)
    state = next((word for word in words[1:] if word.isupper() and word[0].isalpha()), "")
    try:
        mark = int(said["mark"][0])
        peer, answers = (HostPort(said["src"][i], int(said["sport"][i])) for i in range(2))
        reached = HostPort(said["dst"][0], int(said["dport"][0]))
    except (IndexError, ValueError):
        return None
    return _Entry(words[0], state, peer, reached, answers, mark)
