"""Rules about the names that the user gave to ``rosproxy doctor``.

The findings say which pairs of publisher and subscriber are not connected, and why.
"""

from collections.abc import Iterator, Sequence
from difflib import get_close_matches

from rosproxy.doctor.facts import MOST_PAIRS, Attempt, DoctorFacts, NodeFacts, ReachOutcome
from rosproxy.doctor.rules.node import CLEANUP
from rosproxy.doctor.rules.policy import hidden_finding
from rosproxy.doctor.rules.proxy import local_master
from rosproxy.shared.addresses import is_loopback, parse_host_port
from rosproxy.shared.documents.doctor_finding import UNKNOWN_NAME, DoctorFinding, error, note, ok
from rosproxy.shared.fixes import how_to
from rosproxy.shared.output.text import listed, quoted, size
from rosproxy.shared.uris import slave_uri

PAIR = "pair"
"""The name of the check in all findings of this module, except those with UNKNOWN_NAME."""
ANY_TYPE = "*"
MOST_ONE_SIDED = 100
"""Topics without publisher or subscriber that have a finding of their own. A node may have ten
thousand topics."""
MOST_COMPARED_NAMES = 10_000
"""Names that are compared with an unknown name, to find similar names: half a second."""
MOST_LISTED = 5
"""Names of similar topics in a fix; `listed` counts the others."""


def check(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    """All findings about the names that the user gave."""
    if not facts.names:
        return
    if facts.graph is None:
        text = "not checked: the doctor got no list of nodes and topics from the master"
        yield note(PAIR, ", ".join(facts.names), text)
        return
    scope = facts.scope
    yield from (
        hidden_finding(facts.hidden[name]) if name in facts.hidden else _unknown(facts, name)
        for name in scope.unknown
    )
    yield from _one_sided_topics(facts)
    if scope.has_more_pairs:
        text = f"only {MOST_PAIRS} pairs are checked: these topics have more"
        fix = "run the doctor with the names of a publisher and a subscriber"
        yield note(PAIR, ", ".join(facts.names), text, fix)
    yield from (judge_pair(facts, *pair) for pair in scope.pairs)
    yield from (_service(facts, service) for service in scope.services)
    if scope.named_nodes and not scope.pairs:
        yield from _without_pair(facts)


def _without_pair(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    """The finding about nodes without a pair among the names in the user's question.

    No finding if the only topics in the question lack a publisher or a subscriber: these topics
    have findings of their own.
    """
    nodes = facts.scope.named_nodes
    named_topics = [name for name in facts.names if name in facts.system.topics]
    topics = [topic for topic in named_topics if topic not in facts.scope.one_sided_topics]
    together = [name for name in facts.names if name in {*nodes, *topics}]
    if len(together) == 1 or (named_topics and not topics):
        return
    if not topics:
        text = "no topic in common: none of these publishes a topic to which another subscribes"
    elif len(nodes) == 1:
        shown = " or ".join(topics)
        text = f"{nodes[0]} neither publishes {shown} nor subscribes to it"
    else:
        text = f"none of {listed(nodes)} publishes {' or '.join(topics)} to another of them"
    commands = [f"rosnode info {' '.join(map(quoted, nodes))}"]
    commands += [f"rostopic info {quoted(topic)}" for topic in topics]
    fix = f"compare: {'; '.join(commands)}; check namespaces and remappings"
    yield error(PAIR, " and ".join(together), text, fix)


def _unknown(facts: DoctorFacts, name: str) -> DoctorFinding:
    system = facts.system
    names = sorted(system.names() | system.topics | {*system.services})
    alike = get_close_matches(name, names[:MOST_COMPARED_NAMES], 3, 0.7)
    # The user asked for /scan, and there is /robot/scan: the namespace was missing.
    alike += [n for n in names if n.endswith(name) and n not in alike][:3]
    hint = f"; similar names: {listed(alike)}" if alike else ""
    text = f"the master knows no node, topic or service of this name{hint}"
    fix = "compare with rosnode list and rostopic list; check namespaces and remappings"
    return error(UNKNOWN_NAME, name, text, fix)


def _one_sided_topics(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    topics = facts.scope.one_sided_topics
    by_ending: dict[str, list[str]] = {}
    for topic in sorted(facts.system.topics) if topics else ():
        by_ending.setdefault(_ending(topic), []).append(topic)
    for topic in topics[:MOST_ONE_SIDED]:
        alike = [other for other in by_ending[_ending(topic)] if other != topic]
        hidden = facts.hidden.get(topic)
        yield hidden_finding(hidden) if hidden else _one_sided_topic(facts, topic, alike)
    if len(topics) > MOST_ONE_SIDED:
        text = f"{len(topics) - MOST_ONE_SIDED} more topics have no publisher or no subscriber"
        yield note(PAIR, ", ".join(facts.names), text, "run the doctor with the name of a topic")


def _ending(topic: str) -> str:
    """The name of a topic without its namespace."""
    return topic.rpartition("/")[2]


def _one_sided_topic(facts: DoctorFacts, topic: str, alike: Sequence[str]) -> DoctorFinding:
    system = facts.system
    published = bool(system.publishers.get(topic))
    verb, lacks = ("published", "subscribes to") if published else ("subscribed to", "publishes")
    text = f"{verb} by {listed(system.sides(topic))}; no node {lacks} {topic}"
    fix = (
        f"run rostopic info {quoted(topic)}; after a restart of roscore, restart the nodes outside"
    )
    if alike:
        shown = listed([*map(quoted, alike[:MOST_LISTED]), *alike[MOST_LISTED:]])
        fix = f"compare with {shown}, check namespaces and remappings; {fix}"
    return (error if topic in facts.names else note)(PAIR, topic, text, fix)


def judge_pair(facts: DoctorFacts, topic: str, publisher: str, subscriber: str) -> DoctorFinding:
    """The finding that a publisher and a subscriber are connected, or why they are not."""
    publisher_node = facts.nodes[publisher]
    subscriber_node = facts.nodes[subscriber]
    label = f"{topic} from {publisher} to {subscriber}"
    if is_connected(topic, publisher_node, subscriber_node):
        return ok(
            PAIR, label, "connected" + _traffic(facts, topic, publisher_node, subscriber_node)
        )
    text, fix = _reason_unconnected(facts, topic, publisher_node, subscriber_node)
    return error(PAIR, label, f"not connected: {text}", fix)


def is_connected(topic: str, publisher: NodeFacts, subscriber: NodeFacts) -> bool:
    """Whether the report of a publisher has a connection to a subscriber.

    A subscriber also lists connections that are not established yet. So the report of the
    subscriber counts only if the publisher has no report, or does not name the subscribers.
    """
    if publisher.report is not None and topic not in publisher.report.unnamed:
        return ("o", topic, subscriber.name) in publisher.report.peers
    slaves = [slave for slave in (publisher.slave, publisher.inside) if slave]
    uris = {publisher.uri, *(slave_uri(slave, path) for slave in slaves for path in ("", "/"))}
    rows = subscriber.report.peers if subscriber.report else frozenset()
    return any(("i", topic, uri) in rows for uri in uris)


def _traffic(facts: DoctorFacts, topic: str, publisher: NodeFacts, subscriber: NodeFacts) -> str:
    lease = facts.lease(publisher.slave)
    for connection in lease.connections if lease else ():
        if (connection.name, connection.caller_id) == (topic, subscriber.name):
            sent = size(connection.sent)
            rate = size(connection.sent_rate)
            return f", {sent} so far, {rate}/s just now"
    return ""


def _reason_unconnected(
    facts: DoctorFacts, topic: str, publisher: NodeFacts, subscriber: NodeFacts
) -> tuple[str, str]:
    """Reason and fix for an unconnected pair: the most certain reason."""
    for node in (publisher, subscriber):
        if _unreachable(facts, node):
            return (
                f"{node.name} can't be reached from here",
                f"see the finding about {quoted(node.name)}",
            )
    # Without a report, the types count as equal. A subscriber of any type has the type *
    # (rospy.AnyMsg).
    offered = publisher.report.publishes.get(topic) if publisher.report else ANY_TYPE
    wanted = subscriber.report.subscribes.get(topic) if subscriber.report else ANY_TYPE
    if offered is None:
        return (
            f"{publisher.name} is registered as a publisher, but does not publish {topic}",
            f"restart {quoted(publisher.name)}",
        )
    if wanted is None:
        return (
            f"{subscriber.name} is registered as a subscriber, but does not subscribe to {topic}",
            f"restart {quoted(subscriber.name)}",
        )
    if ANY_TYPE not in (offered, wanted) and offered != wanted:
        text = f"types differ: {publisher.name} publishes {offered}, "
        text += f"{subscriber.name} subscribes to {wanted}"
        return text, "use the same message type on both sides"
    return _transport_reason(facts, topic, publisher, subscriber)


def _unreachable(facts: DoctorFacts, node: NodeFacts) -> bool:
    if facts.is_ours(node.slave):
        lease = facts.lease(node.slave)
        return lease is None or lease.state not in ("ok", "new")
    return node.attempt.failed or node.slave is None


def _transport_reason(
    facts: DoctorFacts, topic: str, publisher: NodeFacts, subscriber: NodeFacts
) -> tuple[str, str]:
    address, attempt = facts.data_ports.get((publisher.name, topic), ("", Attempt()))
    target = parse_host_port(address)
    restart = f"restart {quoted(subscriber.name)}"
    if attempt.failed:
        given = f"gives {address} as its data port" if address else "gives no data port"
        text = f"{publisher.name} {given}: {attempt.reach.value}"
        fix = "set ROS_IP=ADDRESS, let the firewall accept connections, then restart the node"
        fix = f"where {quoted(publisher.name)} runs: {fix}"
        return f"{text} ({attempt.reason})" if attempt.reason else text, fix
    elsewhere = not facts.is_ours(publisher.slave) and not local_master(facts)
    if target and is_loopback(target.host) and elsewhere:
        text = f"{publisher.name} gives {address} as its data port, a loopback address"
        fix = "set ROS_IP=ADDRESS, then restart the node"
        return text, f"where {quoted(publisher.name)} runs: {fix}"
    if facts.is_ours(publisher.slave) and not facts.is_ours(subscriber.slave) and publisher.slave:
        slave = publisher.slave
        return (
            f"{publisher.name}, behind the proxy, has no fault. "
            f"{subscriber.name} has not connected to {slave}",
            f"test on the machine of {quoted(subscriber.name)}: "
            f"nc -vz {quoted(slave.host)} {slave.port}; then {restart}",
        )
    if facts.is_ours(subscriber.slave) and not facts.is_ours(publisher.slave):
        return _reason_from_inside(facts, address, publisher, subscriber)
    text = (
        "both nodes answer, and no difference in types is known. Perhaps the message definitions "
        "differ (md5sum)"
    )
    return text, f"read the log of {quoted(subscriber.name)}; {restart}"


def _reason_from_inside(
    facts: DoctorFacts, address: str, publisher: NodeFacts, subscriber: NodeFacts
) -> tuple[str, str]:
    """Reason and fix if a subscriber behind the proxy has not connected to a sound publisher."""
    text = (
        f"{publisher.name} has no fault. {subscriber.name}, behind the proxy, has not connected to"
    )
    differ = "or the message definitions differ (md5sum)"
    log = f"read the log of {quoted(subscriber.name)}"
    if facts.proxy.settings.direction == "both":
        text = f"{text} the proxy's port for {publisher.uri}, {differ}"
        fix = f"{log} and of the proxy; restart {quoted(subscriber.name)}"
        if not facts.proxy.settings.udp:
            fix += f". If the subscriber accepts UDPROS only, {how_to('UDPROS')}"
        return text, fix
    target = parse_host_port(address)
    test = f"a connection to {quoted(publisher.uri)}"
    if target:
        test = f"nc -vz {quoted(target.host)} {target.port}"
    return (
        f"{text} {address or publisher.uri} directly, {differ}",
        f"test where {quoted(subscriber.name)} runs: {test}. If there is no route outwards, "
        f"{how_to('direction both')}. Else {log}",
    )


def _service(facts: DoctorFacts, service: str) -> DoctorFinding:
    uri = facts.service_uris.get(service, "")
    attempt = facts.services.get(service, Attempt())
    providers = listed(facts.system.services.get(service, ()))
    text = f"{providers} provides this service at {uri}: {attempt.reach.value}"
    if not attempt.failed:
        return ok(PAIR, service, text)
    shown = listed(map(quoted, facts.system.services.get(service, ())))
    fix = f"restart {shown}; if the node is gone, {CLEANUP}"
    if attempt.reach is ReachOutcome.UNRESOLVABLE:
        fix = f"where {shown} runs: set ROS_IP=ADDRESS, then restart the node"
    return error(PAIR, service, text, fix)
