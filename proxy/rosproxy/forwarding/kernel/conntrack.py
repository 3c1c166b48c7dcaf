"""What ``conntrack -L`` prints: one connection a line, as the kernel tracks it.

    tcp 6 431999 ESTABLISHED src=A dst=B sport=1 dport=2 src=C dst=D sport=3 dport=4 [ASSURED]
    mark=5 use=1

The first four addresses are of the connection as it came, the others of what answers it.
"""

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import msgspec

from rosproxy.forwarding.kernel.connection_table import Marks
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
    marked = ((e, marks.port(e.mark)) for e in _entries(text) if e.transport == "tcp")
    return [Flow(e.state, e.peer, port, e.reply_source) for e, port in marked if port is not None]


def peers(flows: Iterable[Flow], address: str) -> dict[str, int]:
    """How many open connections each peer has with the node at an address; empty: at any."""
    matching = (flow for flow in flows if address in ("", flow.node.host))
    return dict(Counter(flow.peer.host for flow in matching if flow.state == "ESTABLISHED"))


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
    """A line: ``peer`` sends to ``target``, and ``reply_source`` answers."""

    transport: str
    state: str
    peer: HostPort
    target: HostPort
    reply_source: HostPort
    mark: int


def _entries(text: str) -> Iterator[_Entry]:
    """The lines that make sense."""
    return filter(None, (_entry(line.split()) for line in text.splitlines()))


def _entry(fields: list[str]) -> _Entry | None:
    values: defaultdict[str, list[str]] = defaultdict(list)
    for key, equals, value in (field.partition("=") for field in fields):
        if equals:
            values[key].append(value)
    # Not a mark such as [ASSURED] or [UNREPLIED], which lines of UDP have as well.
    state = next((field for field in fields[1:] if field.isupper() and field[0].isalpha()), "")
    try:
        mark = int(values["mark"][0])
        peer, reply_source = (HostPort(values["src"][i], int(values["sport"][i])) for i in range(2))
        target = HostPort(values["dst"][0], int(values["dport"][0]))
    except (IndexError, ValueError):
        return None
    return _Entry(fields[0], state, peer, target, reply_source, mark)
