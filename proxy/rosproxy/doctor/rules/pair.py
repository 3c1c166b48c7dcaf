"""The names asked for: which publisher and subscriber are not connected, and why."""

from collections.abc import Iterator
from difflib import get_close_matches

from rosproxy.admin.doctor_finding import UNKNOWN_NAME, DoctorFinding, error, note, ok
from rosproxy.doctor.facts import Attempt, DoctorFacts, NodeFacts, ReachOutcome
from rosproxy.doctor.rules.proxy import local_master
from rosproxy.net.addresses import is_loopback, parse_host_port
from rosproxy.telemetry.text import listed, quoted, size

PAIR = "pair"
ANY = "*"


def check(facts: DoctorFacts) -> Iterator[DoctorFinding]:
    """All findings about the names asked for."""
    if not facts.names:
        return
    if facts.graph is None:
        text = "nothing can be said: the master does not answer"
        yield note(PAIR, ", ".join(facts.names), text)
        return
    scope = facts.scope
    yield from (_unknown(facts, name) for name in scope.unknown)
    yield from (_lonely(facts, topic) for topic in scope.one_sided_topics)
    yield from (judge_pair(facts, *pair) for pair in scope.pairs)
    yield from (_service(facts, service) for service in scope.services)
    together = [name for name in facts.names if name not in {*scope.services, *scope.unknown}]
    if scope.named_nodes and len(together) > 1 and not scope.pairs:
        text = "none publishes what another of them subscribes to"
        nodes = " ".join(map(quoted, together))
        fix = f"compare: rosnode info {nodes}; look for namespaces and remappings"
        yield error(PAIR, " and ".join(together), text, fix)


def _unknown(facts: DoctorFacts, name: str) -> DoctorFinding:
    graph = facts.system
    names = sorted(graph.names() | graph.topics | {*graph.services})
    alike = get_close_matches(name, names, 3, 0.7)
    # /scan was asked for, and there is /robot/scan: a namespace was left out.
    alike += [n for n in names if n.endswith(name) and n not in alike][:3]
    hint = f"; there is {listed(alike)}" if alike else ""
    text = f"the master knows no node, topic or service of this name{hint}"
    fix = "compare with rosnode list and rostopic list; check namespaces and remappings"
    return error(UNKNOWN_NAME, name, text, fix)


def _lonely(facts: DoctorFacts, topic: str) -> DoctorFinding:
    graph = facts.system
    published = bool(graph.publishers.get(topic))
    verb, lacks = ("published", "subscribes to") if published else ("subscribed to", "publishes")
    text = f"{verb} by {listed(graph.sides(topic))}; nobody {lacks} it"
    topics = sorted(graph.topics - {topic})
    alike = [t for t in topics if t.rpartition("/")[2] == topic.rpartition("/")[2]]
    fix = f"there is also {listed(map(quoted, alike))}: a namespace or remapping? " if alike else ""
    fix += f"rostopic info {quoted(topic)}; after a restart of roscore, restart the nodes outside"
    return (error if topic in facts.names else note)(PAIR, topic, text, fix)


def judge_pair(facts: DoctorFacts, topic: str, publisher: str, subscriber: str) -> DoctorFinding:
    """Whether a publisher and a subscriber are connected, else why not."""
    publisher_node = facts.nodes[publisher]
    subscriber_node = facts.nodes[subscriber]
    label = f"{topic} from {publisher} to {subscriber}"
    if is_connected(topic, publisher_node, subscriber_node):
        return ok(
            PAIR, label, "connected" + _traffic(facts, topic, publisher_node, subscriber_node)
        )
    text, fix = _why(facts, topic, publisher_node, subscriber_node)
    return error(PAIR, label, f"not connected: {text}", fix)


def is_connected(topic: str, publisher: NodeFacts, subscriber: NodeFacts) -> bool:
    """Whether a publisher says that a subscriber is connected.

    The publisher knows best: a subscriber lists connections that it only tries to make. Where the
    publisher can't be asked, the subscriber's word has to do.
    """
    if publisher.report is not None:
        return ("o", topic, subscriber.name) in publisher.report.peers
    return subscriber.report is not None and ("i", topic, publisher.uri) in subscriber.report.peers


def _traffic(facts: DoctorFacts, topic: str, publisher: NodeFacts, subscriber: NodeFacts) -> str:
    lease = facts.lease(publisher.slave)
    for connection in lease.connections if lease else ():
        if (connection.name, connection.caller_id) == (topic, subscriber.name):
            sent = size(connection.sent)
            rate = size(connection.sent_rate)
            return f", {sent} so far, {rate}/s just now"
    return ""


def _why(
    facts: DoctorFacts, topic: str, publisher: NodeFacts, subscriber: NodeFacts
) -> tuple[str, str]:
    """Why a pair is not connected, the most certain reason first, and what mends it."""
    for node in (publisher, subscriber):
        if _unreachable(facts, node):
            return (
                f"{node.name} can't be reached from here",
                f"see the finding about {quoted(node.name)}",
            )
    # A node that could not be asked is taken to fit. A subscriber to any type has * as its
    # type (rospy.AnyMsg).
    offered = publisher.report.publishes.get(topic) if publisher.report else ANY
    wanted = subscriber.report.subscribes.get(topic) if subscriber.report else ANY
    if offered is None:
        return (
            f"{publisher.name} says that it does not publish it",
            f"restart {quoted(publisher.name)}",
        )
    if wanted is None:
        return (
            f"{subscriber.name} says that it is not subscribed to it",
            f"restart {quoted(subscriber.name)}",
        )
    if ANY not in (offered, wanted) and offered != wanted:
        return f"types differ, {offered} and {wanted}", "use the same message type on both sides"
    return _why_no_transport(facts, topic, publisher, subscriber)


def _unreachable(facts: DoctorFacts, node: NodeFacts) -> bool:
    if facts.is_ours(node.slave):
        lease = facts.lease(node.slave)
        return lease is None or lease.state not in ("ok", "new")
    return node.attempt.failed or node.slave is None


def _why_no_transport(
    facts: DoctorFacts, topic: str, publisher: NodeFacts, subscriber: NodeFacts
) -> tuple[str, str]:
    address, attempt = facts.data_ports.get((publisher.name, topic), ("", Attempt()))
    target = parse_host_port(address)
    restart = f"restart {quoted(subscriber.name)}"
    if attempt.failed:
        description = (
            f"{publisher.name} gives {address or 'nothing'} as its data port, {attempt.reach.value}"
        )
        set_ip = "ROS_IP=ADDRESS and no firewall, then restart it"
        set_ip = f"where {quoted(publisher.name)} runs: {set_ip}"
        return f"{description} ({attempt.reason})" if attempt.reason else description, set_ip
    elsewhere = not facts.is_ours(publisher.slave) and not local_master(facts)
    if target and is_loopback(target.host) and elsewhere:
        text = f"{publisher.name} gives {address} as its data port, which is loopback"
        return text, f"where {quoted(publisher.name)} runs: ROS_IP=ADDRESS, then restart it"
    if facts.is_ours(publisher.slave) and not facts.is_ours(subscriber.slave) and publisher.slave:
        slave = publisher.slave
        return (
            f"{publisher.name} is behind the proxy and fine; "
            f"{subscriber.name} has not connected to {slave}",
            f"on the machine of {quoted(subscriber.name)}: "
            f"nc -vz {quoted(slave.host)} {slave.port}; then {restart}",
        )
    if facts.is_ours(subscriber.slave) and not facts.is_ours(publisher.slave):
        return _why_not_from_inside(facts, address, publisher, subscriber)
    text = "both answer and their types fit; perhaps their message definitions differ (md5sum)"
    return text, f"look into the log of {quoted(subscriber.name)}; {restart}"


def _why_not_from_inside(
    facts: DoctorFacts, address: str, publisher: NodeFacts, subscriber: NodeFacts
) -> tuple[str, str]:
    """Why a subscriber behind the proxy has not connected to a publisher that is well."""
    text = f"{publisher.name} is fine; {subscriber.name}, behind the proxy, has not connected to"
    differ = "or their message definitions differ (md5sum)"
    log = f"look into the log of {quoted(subscriber.name)}"
    if facts.proxy.settings.direction == "both":
        text = f"{text} the proxy's port for {publisher.uri}, {differ}"
        fix = f"{log} and of the proxy; restart {quoted(subscriber.name)}"
        if not facts.proxy.settings.udp:
            fix += "; if it wants UDP alone: --udp (label rosproxy.udp=true, spec.udp: true)"
        return text, fix
    target = parse_host_port(address)
    test = f"a connection to {quoted(publisher.uri)}"
    if target:
        test = f"nc -vz {quoted(target.host)} {target.port}"
    return (
        f"{text} {address or publisher.uri} by itself, {differ}",
        f"where {quoted(subscriber.name)} runs: {test}; if there is no route outwards, the proxy "
        "can be the way: --direction both (label rosproxy.direction=both, spec.direction: Both); "
        f"else {log}",
    )


def _service(facts: DoctorFacts, service: str) -> DoctorFinding:
    uri = facts.service_uris.get(service, "")
    attempt = facts.services.get(service, Attempt())
    providers = listed(facts.system.services.get(service, ()))
    text = f"{providers} provides it at {uri}: {attempt.reach.value}"
    if not attempt.failed:
        return ok(PAIR, service, text)
    shown = listed(map(quoted, facts.system.services.get(service, ())))
    fix = f"restart {shown}; if it is gone: rosnode cleanup"
    if attempt.reach is ReachOutcome.UNRESOLVABLE:
        fix = f"where {shown} runs: ROS_IP=ADDRESS, then restart it"
    return error(PAIR, service, text, fix)
