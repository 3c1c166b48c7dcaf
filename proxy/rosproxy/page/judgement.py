"""The doctor's findings on a running proxy for the live page, after each round of questions.

Nodes start and end during a round. So the doctor judges with the status from before the round and
with the status from after the round, and the page shows only findings of both.
"""

from collections.abc import Collection, Mapping

import msgspec
from msgspec.structs import replace

from rosproxy.doctor.facts import DoctorFacts, SystemState
from rosproxy.doctor.rules import diagnose_running
from rosproxy.doctor.rules.pair import judge_pair
from rosproxy.page.measures import Key
from rosproxy.page.page_document import MOST_LINKS, QUIET
from rosproxy.shared.documents.doctor_finding import DoctorFinding, Severity
from rosproxy.shared.documents.status_document import EndpointStatus, ProxyStatus


class JudgedFacts(msgspec.Struct, frozen=True):
    """The ``facts`` with the doctor's findings on nodes, on pairs, and on the rest.

    ``unconnected_pairs``: all pairs that are not connected. ``pairs``: a finding for each pair,
    also for a connected pair, but not for a pair that is in ``unconnected_pairs`` for the first
    time.
    """

    facts: DoctorFacts
    nodes: dict[str, DoctorFinding] = {}
    pairs: dict[Key, DoctorFinding] = {}
    rest: tuple[DoctorFinding, ...] = ()
    unconnected_pairs: frozenset[Key] = frozenset()


def topics_to_ask_about(status: ProxyStatus, graph: SystemState) -> tuple[str, ...]:
    """The topics about which to ask nodes: topics of nodes inside, up to MOST_LINKS links.

    Without the topics that nearly every node has (QUIET). A topic whose links exceed the rest of
    MOST_LINKS is left out; later topics with fewer links are not.
    """
    inside = inside_nodes(status)
    topics = []
    remaining = MOST_LINKS
    for topic in sorted(graph.topics - QUIET):
        if not inside.keys() & {*graph.sides(topic)}:
            continue
        count = len(graph.publishers.get(topic, ())) * len(graph.subscribers.get(topic, ()))
        if count > remaining:
            continue
        remaining -= count
        topics.append(topic)
    return tuple(topics)


def judge(
    facts: DoctorFacts, previous: JudgedFacts | None = None, later: ProxyStatus | None = None
) -> JudgedFacts:
    """Have the doctor judge ``facts``. ``previous``: the judgement of the round before.

    ``later``: the status of the proxy after the round; None: judge only by ``facts``. A pair counts
    as unconnected only after two rounds in a row: nodes that start need a moment to connect.
    """
    nodes: dict[str, DoctorFinding] = {}
    rest = []
    inside = inside_nodes(facts.proxy)
    for finding in _lasting(facts, later):
        if finding.subject not in facts.nodes and finding.subject not in inside:
            rest.append(finding)
        elif finding.subject not in nodes or nodes[finding.subject].severity < finding.severity:
            nodes[finding.subject] = finding
    pairs = {
        pair: judge_pair(facts, *pair)
        for pair in facts.scope.pairs
        if inside.keys() & {pair[1], pair[2]}
    }
    unconnected = frozenset(key for key, f in pairs.items() if f.severity is Severity.ERROR)
    for key in unconnected - (previous.unconnected_pairs if previous else frozenset()):
        del pairs[key]
    return JudgedFacts(facts, nodes, pairs, tuple(rest), unconnected)


def _lasting(facts: DoctorFacts, later: ProxyStatus | None) -> list[DoctorFinding]:
    """The findings that hold with the status before the round and with the status ``later``.

    A node that registers or ends during the round is in only one status, and has no finding.
    """
    before = _warnings_and_errors(facts)
    if later is None:
        return before
    after = {(f.check, f.subject) for f in _warnings_and_errors(replace(facts, status=later))}
    return [f for f in before if (f.check, f.subject) in after]


def _warnings_and_errors(facts: DoctorFacts) -> list[DoctorFinding]:
    findings = diagnose_running(replace(facts, names=()))
    return [finding for finding in findings if finding.severity >= Severity.WARNING]


def without_ended(judged: JudgedFacts, status: ProxyStatus) -> JudgedFacts:
    """The judgement without nodes that have ended by a newer ``status``.

    A node with the same name stays if the master has another URI for the name.
    """
    ended_endpoints = [endpoint for endpoint in status.nodes if endpoint.has_ended]
    ended_uris = {endpoint.advertised_uri for endpoint in ended_endpoints}
    known = judged.facts.nodes
    ended = {
        name
        for endpoint in ended_endpoints
        for name in endpoint.nodes
        if name not in known or known[name].uri in ended_uris
    } - inside_nodes(status).keys()
    if not ended:
        return judged
    system = judged.facts.system
    facts = replace(
        judged.facts,
        nodes={name: node for name, node in known.items() if name not in ended},
        graph=SystemState(
            publishers=_without_names(system.publishers, ended),
            subscribers=_without_names(system.subscribers, ended),
            services=_without_names(system.services, ended),
        ),
    )
    nodes = {name: finding for name, finding in judged.nodes.items() if name not in ended}
    pairs = {key: finding for key, finding in judged.pairs.items() if ended.isdisjoint(key[1:])}
    return replace(judged, facts=facts, nodes=nodes, pairs=pairs)


def _without_names(table: Mapping[str, list[str]], names: Collection[str]) -> dict[str, list[str]]:
    kept = {key: [name for name in row if name not in names] for key, row in table.items()}
    return {key: row for key, row in kept.items() if row}


def inside_nodes(status: ProxyStatus) -> dict[str, EndpointStatus]:
    """The endpoints of nodes inside by name, without endpoints that have ended."""
    present = [endpoint for endpoint in status.nodes if not endpoint.has_ended]
    return {name: endpoint for endpoint in present for name in endpoint.nodes}
