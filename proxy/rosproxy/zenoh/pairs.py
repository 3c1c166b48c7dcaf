"""Which nodes of rmw_zenoh exchange a topic or service, and why two nodes do not.

Two nodes meet if domain, name, type and type hash are the same, no rule of the policy hides the
name, and the routers pass the data. The proxy knows its own routers and the liveliness tokens. The
proxy does not see whether messages arrive, and knows no rules of routers outside.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator
from itertools import chain, islice
from typing import NamedTuple

from rosproxy.shared.documents.doctor_finding import DoctorFinding, note, ok, warning
from rosproxy.shared.documents.status_document import PolicyStatus, ZenohNodeStatus, ZenohStatus
from rosproxy.shared.output.text import listed
from rosproxy.shared.policy.rules import RuleKind
from rosproxy.zenoh.findings import PEER, mismatch_findings, place, shared_ports
from rosproxy.zenoh.links import LinkFault

TOPIC = "topic"
SERVICE = "service"
MATCH = "match"
"""The check of the finding about two nodes that nothing keeps apart, as far as is known."""
MOST_NAMED_NODES = 3
"""Nodes of another domain that a text names."""
MOST_JUDGED_PAIRS = 3000
"""Pairs that `troubles` judges."""
_RULES = {
    TOPIC: (RuleKind.PUBLISH.value, RuleKind.SUBSCRIBE.value),
    SERVICE: (RuleKind.SERVE.value, RuleKind.CALL.value),
}
_ROLES = {TOPIC: ("publisher", "subscription"), SERVICE: ("server", "client")}
_Names = tuple[str, int, str]
"""Kind, domain and name of a topic or service."""


class Sides(NamedTuple):
    """The nodes that publish or serve a name, and the nodes that subscribe or call."""

    sources: list[ZenohNodeStatus]
    targets: list[ZenohNodeStatus]


class Pair(NamedTuple):
    """A topic from a publisher to a subscriber, or a service from a server to a client.

    One end is None if only the other node is known.
    """

    kind: str
    name: str
    source: ZenohNodeStatus | None
    target: ZenohNodeStatus | None


class Graph:
    """The topics and services of the nodes, by name."""

    def __init__(self, zenoh: ZenohStatus, policy: PolicyStatus | None) -> None:
        self._shared = shared_ports(zenoh)
        self._mismatches = {
            (pair.kind, pair.name, pair.writer, pair.reader): finding
            for pair, finding in mismatch_findings(zenoh)
        }
        policy = policy or PolicyStatus()
        self._hidden = {(h.kind, h.name, h.node, h.address): h.reason for h in policy.hidden}
        self._is_complete = not (policy.left_out or zenoh.mismatches_left_out or zenoh.not_compared)
        self._down = [
            link.title
            for link in zenoh.links
            if not link.up and link.error != LinkFault.NOT_TRIED.value
        ]
        self.by_name: defaultdict[_Names, Sides] = defaultdict(lambda: Sides([], []))
        self._domains: defaultdict[tuple[str, str], set[int]] = defaultdict(set)
        for node in zenoh.nodes:
            self._add(node)

    def _add(self, node: ZenohNodeStatus) -> None:
        for kind, side, names in (
            (TOPIC, 0, node.publishes),
            (TOPIC, 1, node.subscribes),
            (SERVICE, 0, node.services),
            (SERVICE, 1, node.calls),
        ):
            for name in names:
                self.by_name[kind, node.domain, name][side].append(node)
                self._domains[kind, name].add(node.domain)

    def size(self, names: _Names) -> int:
        """The most pairs that `pairs` yields."""
        sources, targets = self.by_name[names]
        inside = [sum(map(is_inside, side)) for side in (sources, targets)]
        outside = [len(sources) - inside[0], len(targets) - inside[1]]
        return len(sources) * len(targets) - outside[0] * outside[1] + sum(inside)

    def pairs(self, names: _Names) -> Iterator[Pair]:
        """Yield the pairs of a topic or service with a node inside.

        A publisher or server inside without another end is a pair as well, and so is a subscriber.
        """
        kind, _, name = names
        sources, targets = self.by_name[names]
        targets_inside = [*filter(is_inside, targets)]
        for source in sources:
            ends = [t for t in (targets if is_inside(source) else targets_inside) if t != source]
            yield from (Pair(kind, name, source, target) for target in ends)
            if not ends and is_inside(source):
                yield Pair(kind, name, source, None)
        if kind == TOPIC:
            for target in targets_inside:
                if all(source == target for source in sources):
                    yield Pair(kind, name, None, target)

    def judge(self, pair: Pair) -> DoctorFinding:
        """The finding about a pair: why the nodes do not meet, as far as the proxy knows.

        A note: the nodes do not meet on purpose, or that is not known.
        """
        kind, name, source, target = pair
        subject = f"{kind} {name}"
        if source is None or target is None:
            return self._judge_alone(pair, subject)
        mismatch = self._mismatches.get((kind, name, source.key, target.key))
        if mismatch and mismatch.check != "qos":
            return mismatch
        if source.port != target.port and (by_policy := self._by_policy(pair, subject)):
            return by_policy
        if shared := self._shared_port(source, target):
            return shared
        if not self._is_complete:
            return note("type", subject, "not known: the status leaves out rules or pairs")
        return mismatch or ok(MATCH, subject, f"{place(source)} and {place(target)} match")

    def _shared_port(
        self, source: ZenohNodeStatus, target: ZenohNodeStatus
    ) -> DoctorFinding | None:
        """The finding about a router of the proxy with both nodes as its peers, if any."""
        is_between_peers = source.mode == target.mode == PEER and source.port == target.port
        is_apart = is_between_peers and source.address != target.address
        return self._shared.get(source.port) if is_apart else None

    def _judge_alone(self, pair: Pair, subject: str) -> DoctorFinding:
        """The finding about a name with only one known end."""
        kind, name, source, target = pair
        node = source or target or ZenohNodeStatus()
        missing = _ROLES[kind][1 if source else 0]
        if by_policy := self._by_policy(pair, subject):
            return by_policy
        text = f"no {missing} is known in domain {node.domain}"
        if others := [*self._alone_elsewhere(kind, name, node.domain, 1 if source else 0)]:
            named = [f"{place(o)} in domain {o.domain}" for o in others[:MOST_NAMED_NODES]]
            fix = "if the nodes shall meet, set the same ROS_DOMAIN_ID for both"
            return warning("domain", subject, f"{text}, but: {listed(named)}", fix)
        if self._down:
            text += f". No link to {listed(self._down)}: the nodes there are not known"
        return note("alone", subject, text)

    def _alone_elsewhere(
        self, kind: str, name: str, domain: int, side: int
    ) -> Iterator[ZenohNodeStatus]:
        """Yield the nodes of other domains that lack the other end, too."""
        for other in sorted(self._domains[kind, name] - {domain}):
            sides = self.by_name[kind, other, name]
            if not sides[1 - side]:
                yield from sides[side]

    def _by_policy(self, pair: Pair, subject: str) -> DoctorFinding | None:
        """The finding about a rule that hides the name, or may hide the name, at a node inside."""
        ends = [
            (rule, node)
            for rule, node in zip(_RULES[pair.kind], (pair.source, pair.target), strict=True)
            if node and is_inside(node)
        ]
        reasons = (self._hidden.get((rule, pair.name, n.name, n.address)) for rule, n in ends)
        if reason := next(filter(None, reasons), ""):
            text = f"hidden from outside by the policy: {reason}"
            fix = f"if these nodes shall exchange {pair.name}, change the rule"
            return note("policy", subject, text, fix)
        if any(node.not_judged for _, node in ends):
            text = "not known yet: the proxy compares the names with the rules of the policy"
            return note("policy", subject, text)
        return None


def is_inside(node: ZenohNodeStatus) -> bool:
    """Whether a node has a session at a port for containers."""
    return node.port is not None


def troubles(graph: Graph, name: str) -> Iterable[DoctorFinding]:
    """The findings that say why nodes do not exchange the topic or service ``name``."""
    names = [key for key in graph.by_name if key[2] == name]
    pairs = islice(chain.from_iterable(map(graph.pairs, names)), MOST_JUDGED_PAIRS)
    found = map(graph.judge, pairs)
    return dict.fromkeys(finding for finding in found if finding.check not in (MATCH, "alone"))
