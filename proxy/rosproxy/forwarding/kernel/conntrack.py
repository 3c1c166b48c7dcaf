"""The connections of a proxy, counted from the output of ``conntrack -L``: one line a connection.

    tcp 6 431999 ESTABLISHED src=A dst=B sport=1 dport=2 src=C dst=D sport=3 dport=4 [ASSURED]
    mark=5 use=1

The first two addresses and ports are of packets from the peer, the last two of replies from the
node. A flood makes tens of thousands of lines. So a `Survey` reads the list piece by piece, and
keeps only counts and a few connections.
"""

import re
from collections.abc import Iterable, Mapping

import msgspec

from rosproxy.forwarding.kernel.connection_table import Marks
from rosproxy.shared.addresses import HostPort

MOST_PEERS = 256
"""Addresses of peers of a port that have separate counts; OTHERS counts all further connections."""
OTHERS = "others"
"""The name that stands for all further peers of a port."""
MOST_WAITING = 64
"""Unanswered connections of a port that are watched at most; a single one proves the fault."""

# Other states are of connections that begin or end. The patterns bound the digits: 5 for a port,
# 10 for a mark of 32 bits.
_LINE = re.compile(
    r"^tcp +6 [0-9]+ (ESTABLISHED|SYN_SENT) src=(\S+) dst=\S+ sport=([0-9]{1,5}) "
    r".*?src=(\S+) dst=\S+ sport=([0-9]{1,5}) .*?mark=([0-9]{1,10})",
    re.MULTILINE,
)

OpenConnections = Mapping[tuple[int, str], Mapping[str, int]]
"""Numbers of connections by peer address, for each pair of port and node address."""


class Flow(msgspec.Struct, frozen=True):
    """A TCP connection that the kernel forwards: from ``peer`` through ``port`` to ``node``."""

    peer: HostPort
    port: int
    node: HostPort


class Survey:
    """The connections of a proxy, selected by the marks of its table.

    ``open`` counts established connections. ``waiting`` are connections that the node has not
    answered yet, at most `MOST_WAITING` for each port.
    """

    def __init__(self, marks: Marks) -> None:
        self._marks = marks
        self._waiting: dict[int, list[Flow]] = {}
        self._open: dict[tuple[int, str], dict[str, int]] = {}

    @property
    def open(self) -> OpenConnections:
        """The numbers of open (established) connections."""
        return self._open

    @property
    def waiting(self) -> list[Flow]:
        """The unanswered connections."""
        return [flow for flows in self._waiting.values() for flow in flows]

    def add(self, lines: str) -> None:
        """Add whole lines of the list; malformed lines don't count."""
        for state, peer, peer_port, node, node_port, mark in _LINE.findall(lines):
            port = self._marks.port(int(mark))
            if port is None:
                continue
            if state == "ESTABLISHED":
                self._count(port, node, peer)
            else:
                flow = Flow(HostPort(peer, int(peer_port)), port, HostPort(node, int(node_port)))
                self._watch(flow)

    def _count(self, port: int, node: str, peer: str) -> None:
        counts = self._open.setdefault((port, node), {})
        name = peer if peer in counts or len(counts) < MOST_PEERS else OTHERS
        counts[name] = counts.get(name, 0) + 1

    def _watch(self, flow: Flow) -> None:
        flows = self._waiting.setdefault(flow.port, [])
        if len(flows) < MOST_WAITING:
            flows.append(flow)


class Watch:
    """Finds connections that the node has not answered for ``patience`` seconds."""

    def __init__(self, patience: float) -> None:
        self._patience = patience
        self._since: dict[Flow, float] = {}

    def look(self, waiting: Iterable[Flow], now: float) -> list[Flow]:
        """The connections that have been unanswered for ``patience`` seconds.

        ``waiting``: all unanswered connections at the time ``now``, in seconds. A connection that
        is missing there counts as new if it appears again.
        """
        self._since = {flow: self._since.get(flow, now) for flow in waiting}
        return [flow for flow, since in self._since.items() if now - since >= self._patience]
