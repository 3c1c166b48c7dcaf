"""The names asked for: which publisher and subscriber are not connected, and why."""

from collections.abc import Iterator
from difflib import get_close_matches

from rosproxy.admin.findings import DoctorFinding, error, note, ok
from rosproxy.doctor.facts import Attempt, DoctorFacts, NodeFacts, Reach
from rosproxy.doctor.rules.proxy import local_master
from rosproxy.net.addresses import is_loopback, parse_host_port
from rosproxy.telemetry.text import listed, size

PAIR, ANY = "pair", "*"


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
    yield from (_lonely(facts, topic) for topic in scope.lonely)
    yield from (judge_pair(facts, *pair) for pair in scope.pairs)
    yield from (_service(facts, service) for service in scope.services)
    together = [name for name in facts.names if name not in {*scope.services, *scope.unknown}]
    if scope.named and len(together) > 1 and not scope.pairs:
        text = "none publishes what another of them subscribes to"
        fix = f"compare: rosnode info {' '.join(together)}; look for namespaces and remappings"
        yield error(PAIR, " and ".join(together), text, fix)


def _unknown(facts: DoctorFacts, name: str) -> DoctorFinding:
    graph = facts.system
    known = sorted(graph.names() | graph.topics | {*graph.services})
    alike = get_close_matches(name, known, 3, 0.7)
    alike += [other for other in known if other.endswith(name) and other not in alike][:3]
    hint = f"; there is {listed(alike)}" if alike else ""
    text = f"the master knows no node, topic or service of this name{hint}"
    fix = "rosnode list; rostopic list; look for a namespace or a remapping too many"
    return error(PAIR, name, text, fix)


def _lonely(facts: DoctorFacts, topic: str) -> DoctorFinding:
    graph = facts.system
    published = bool(graph.publishers.get(topic))
    who, lacks = ("published", "subscribes to") if published else ("subscribed to", "publishes")
    text = f"{who} by {listed(graph.sides(topic))}; nobody {lacks} it"
    others = sorted(graph.topics - {topic})
    alike = [o for o in others if o.rpartition("/")[2] == topic.rpartition("/")[2]]
    fix = f"there is also {listed(alike)}: a namespace or remapping? " if alike else ""
    fix += f"rostopic info {topic}; after a restart of roscore, restart the nodes outside"
    return (error if topic in facts.names else note)(PAIR, topic, text, fix)


def judge_pair(facts: DoctorFacts, topic: str, publisher: str, subscriber: str) -> DoctorFinding:
    """Whether a publisher and a subscriber are connected, else why not."""
    giver, taker = facts.nodes[publisher], facts.nodes[subscriber]
    label = f"{topic} from {publisher} to {subscriber}"
    if connected(topic, giver, taker):
        return ok(PAIR, label, "connected" + _traffic(facts, topic, giver, taker))
    text, fix = _why(facts, topic, giver, taker)
    return error(PAIR, label, f"not connected: {text}", fix)


def connected(topic: str, giver: NodeFacts, taker: NodeFacts) -> bool:
    """Whether a publisher says that a subscriber is connected.

    The publisher knows best: a subscriber lists connections that it only tries to make. Where the
    publisher can't be asked, the subscriber's word has to do.
    """
    if giver.report is not None:
        return ("o", topic, taker.name) in giver.report.peers
    return taker.report is not None and ("i", topic, giver.uri) in taker.report.peers


def _traffic(facts: DoctorFacts, topic: str, giver: NodeFacts, taker: NodeFacts) -> str:
    lease = facts.lease(giver.where)
    for connection in lease.connections if lease else ():
        if (connection.name, connection.caller_id) == (topic, taker.name):
            sent, rate = size(connection.sent), size(connection.sent_rate)
            return f", {sent} so far, {rate}/s just now"
    return ""


def _why(facts: DoctorFacts, topic: str, giver: NodeFacts, taker: NodeFacts) -> tuple[str, str]:
    """Why a pair is not connected, the most certain reason first, and what mends it."""
    for node in (giver, taker):
        if _unreachable(facts, node):
            return f"{node.name} can't be reached from here", "see what is said of it"
    offered = giver.report.publishes.get(topic) if giver.report else ANY
    wanted = taker.report.subscribes.get(topic) if taker.report else ANY
    if offered is None:
        return f"{giver.name} says that it does not publish it", f"restart {giver.name}"
    if wanted is None:
        return f"{taker.name} says that it is not subscribed to it", f"restart {taker.name}"
    if ANY not in (offered, wanted) and offered != wanted:
        return f"types differ, {offered} and {wanted}", "use the same message type on both sides"
    return _why_no_transport(facts, topic, giver, taker)


def _unreachable(facts: DoctorFacts, node: NodeFacts) -> bool:
    if facts.ours(node.where):
        lease = facts.lease(node.where)
        return lease is None or lease.state not in ("ok", "new")
    return node.attempt.failed or node.where is None


def _why_no_transport(
    facts: DoctorFacts, topic: str, giver: NodeFacts, taker: NodeFacts
) -> tuple[str, str]:
    address, attempt = facts.data_ports.get((giver.name, topic), ("", Attempt()))
    where = parse_host_port(address)
    restart = f"restart {taker.name}"
    if attempt.failed:
        what = f"{giver.name} gives {address or 'nothing'} as its data port, {attempt.reach.value}"
        set_ip = f"where {giver.name} runs: ROS_IP=ADDRESS and no firewall, then restart it"
        return f"{what} ({attempt.reason})" if attempt.reason else what, set_ip
    elsewhere = not facts.ours(giver.where) and not local_master(facts)
    if where and is_loopback(where.host) and elsewhere:
        text = f"{giver.name} gives {address} as its data port, which is loopback"
        return text, f"where {giver.name} runs: ROS_IP=ADDRESS, then restart it"
    if facts.ours(giver.where) and not facts.ours(taker.where) and giver.where:
        port = giver.where
        return (
            f"{giver.name} is behind the proxy and fine; {taker.name} has not come to {port}",
            f"on the machine of {taker.name}: nc -vz {port.host} {port.port}; then {restart}",
        )
    if facts.ours(taker.where) and not facts.ours(giver.where):
        return _why_not_from_inside(facts, address, giver, taker)
    text = "both answer and their types fit; perhaps their message definitions differ (md5sum)"
    return text, f"look into the log of {taker.name}; {restart}"


def _why_not_from_inside(
    facts: DoctorFacts, address: str, giver: NodeFacts, taker: NodeFacts
) -> tuple[str, str]:
    """Why a subscriber behind the proxy has not come to a publisher that is well."""
    text = f"{giver.name} is fine; {taker.name}, behind the proxy, has not come to"
    differ = "or their message definitions differ (md5sum)"
    log = f"look into the log of {taker.name}"
    if facts.proxy.settings.direction == "both":
        text = f"{text} the proxy's port for {giver.uri}, {differ}"
        fix = f"{log} and of the proxy; restart {taker.name}"
        if not facts.proxy.settings.udp:
            fix += "; if it wants UDP alone: --udp (label rosproxy.udp=true, spec.udp: true)"
        return text, fix
    where = parse_host_port(address)
    test = f"nc -vz {where.host} {where.port}" if where else f"a connection to {giver.uri}"
    return (
        f"{text} {address or giver.uri} by itself, {differ}",
        f"where {taker.name} runs: {test}; if there is no route outwards, the proxy can be the "
        "way: --direction both (label rosproxy.direction=both, spec.direction: Both); else "
        f"{log}",
    )


def _service(facts: DoctorFacts, service: str) -> DoctorFinding:
    uri, attempt = facts.service_uris.get(service, ""), facts.services.get(service, Attempt())
    providers = listed(facts.system.services.get(service, ()))
    text = f"{providers} provides it at {uri}: {attempt.reach.value}"
    if not attempt.failed:
        return ok(PAIR, service, text)
    fix = f"restart {providers}; if it is gone: rosnode cleanup"
    if attempt.reach is Reach.UNRESOLVABLE:
        fix = f"where {providers} runs: ROS_IP=ADDRESS, then restart it"
    return error(PAIR, service, text, fix)
