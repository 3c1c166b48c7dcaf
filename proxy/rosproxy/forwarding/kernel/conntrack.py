"""What ``conntrack -L`` prints: one connection a line, as the kernel tracks it.

    tcp 6 431999 ESTABLISHED src=A dst=B sport=1 dport=2 src=C dst=D sport=3 dport=4 [ASSURED]
    mark=5 use=1

The first four addresses are of the connection as it came, the others of what answers it.
"""

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence

import msgspec

from rosproxy.forwarding.kernel.nft import Marks
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
    flows = (_flow(line.split(), marks) for line in text.splitlines())
    return [flow for flow in flows if flow]


def peers(flows: Iterable[Flow], address: str) -> dict[str, int]:
    """How many open connections each peer has with the node at an address."""
    there = (flow for flow in flows if flow.node.host == address)
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


def _flow(words: list[str], marks: Marks) -> Flow | None:
    said: defaultdict[str, list[str]] = defaultdict(list)
    for key, equals, value in (word.partition("=") for word in words):
        if equals:
            said[key].append(value)
    state = next((word for word in words[1:] if word.isupper() and word[0].isalpha()), "")
    try:
        port = marks.port(int(said["mark"][0]))
        there, node = (HostPort(said["src"][i], int(said["sport"][i])) for i in range(2))
    except (IndexError, ValueError):
        return None
    return Flow(state, there, port, node) if words[0] == "tcp" and port is not None else None
