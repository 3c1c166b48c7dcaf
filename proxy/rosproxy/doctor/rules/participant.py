"""Rules about ROS 2: whether participants of both sides discover each other.

The proxy itself finds most faults (`rosproxy.ros2.domain_problems`). The doctor adds the
participants inside that the proxy does not hear, and the names in the user's question.
"""

from collections.abc import Iterator
from itertools import islice, product

from rosproxy.doctor.facts import DoctorFacts, HeardParticipant
from rosproxy.doctor.rules.policy import hidden_finding
from rosproxy.ros2.domain_problems import DomainProblem, domain_problems, participant_label
from rosproxy.shared.addresses import parse_host_port
from rosproxy.shared.documents.doctor_finding import (
    UNKNOWN_NAME,
    DoctorFinding,
    error,
    note,
    ok,
    warning,
)
from rosproxy.shared.documents.status_document import DomainStatus, ParticipantStatus
from rosproxy.shared.fixes import how_to
from rosproxy.shared.output.text import listed, plural

MOST_PAIRS = 5000
"""Pairs of participants with the topic in question that the doctor reports at most."""
RECENT_S = 120.0
"""Seconds for which the doctor reports a refusal. The proxy notes a lasting refusal more often."""
SETTLED_AFTER_S = 10.0
"""Seconds after the start of the proxy in which the status may lack participants.

The proxy may still ask these participants for their former ports
(`rosproxy.ros2.ports.former_ports`).
"""
OTHER_DOMAIN = "domain"
"""The check for a participant on a network inside that is in another domain."""
OWN_MACHINE = "range"
"""The check for a participant on a network inside that announces itself only on its own machine."""
UNSELECTED = "selected"
"""The check for a participant at an address inside that the operator has not selected."""
HIDDEN = "refused: hidden source"
RELAY_PROOF = "refused: relay proof"
"""With these refusals, no participant outside is heard. So they are errors."""
_REFUSED = {
    "refused: no locator": (
        "where the participant runs: for (tcp) unset FASTDDS_BUILTIN_TRANSPORTS; for (loopback) "
        "set ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET; for (elsewhere) start a proxy, since the "
        "participant is behind NAT; for (missing) add the transport UDPv4 to the profile"
    ),
    "refused: not a peer": (
        "if participants at this address shall meet participants inside, {peer}"
    ),
    HIDDEN: "{hidden source}",
    RELAY_PROOF: "{relay proof}",
    "refused: participants": (
        "to see the participants, {status}; docs/reference/limits.md lists the bounds"
    ),
}
"""The fix for refusals, by the subject of the problem, with keys of `how_to` in braces."""


def check(facts: DoctorFacts) -> list[DoctorFinding]:
    """All findings about the domains."""
    domains = facts.proxy.domains
    is_settled = facts.proxy.uptime >= SETTLED_AFTER_S
    findings = [finding for domain in domains for finding in _domain(domain, is_settled)]
    if is_settled:
        known = {p.guid_prefix for domain in domains for side in _sides(domain) for p in side}
        findings += [
            finding
            for heard in facts.heard_participants
            for finding in _heard(heard, domains, known)
        ]
    findings += [
        (error if problem.subject in (HIDDEN, RELAY_PROOF) else warning)(
            "refused", problem.subject, problem.text, _refused_fix(problem.subject)
        )
        for problem in facts.proxy.problems
        if domains and problem.subject in _REFUSED and problem.age < RECENT_S
    ]
    if domains:
        findings += [
            finding
            for name in facts.names
            for finding in (
                [hidden_finding(facts.hidden[name])]
                if name in facts.hidden
                else _name_in_domains(name, domains)
            )
        ]
    return findings


def _refused_fix(subject: str) -> str:
    keys = ("peer", "hidden source", "relay proof", "status")
    return _REFUSED[subject].format_map({key: how_to(key) for key in keys})


def _domain(domain: DomainStatus, is_settled: bool) -> Iterator[DoctorFinding]:
    subject = f"domain {domain.domain}"
    if not domain.peers and not domain.lan_relay:
        text = "no peer and no LAN relay is set, so the proxy announces participants inside to no "
        text += "host outside"
        fix = f"{how_to('peer')}; or {how_to('LAN relay')}"
        yield error("announcing", subject, text, fix)
    if not domain.inside and not is_settled:
        text = "no participant inside has been heard yet; the proxy has just started"
        yield note("inside", subject, text, "wait some seconds")
    elif not domain.inside:
        text = "no participant inside has been heard"
        fix = (
            f"{how_to('participants inside')}, and set "
            f"ROS_DOMAIN_ID={domain.domain} and ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET. Unset "
            "ROS_LOCALHOST_ONLY, ROS_DISCOVERY_SERVER, and what names other interfaces "
            "(CYCLONEDDS_URI, DDS profiles). If the "
            "network has no multicast, set ROS_STATIC_PEERS to the proxy's address there. "
            "RMW_IMPLEMENTATION=rmw_zenoh_cpp does not use DDS: "
            f"{how_to('rmw_zenoh')}"
        )
        yield warning("inside", subject, text, fix)
    else:
        yield ok("inside", subject, f"inside: {_counted(domain.inside)}")
    if domain.outside:
        yield ok("outside", subject, f"outside: {_counted(domain.outside)}")
    yield from _silence(domain)
    yield from map(_finding, domain_problems(domain))


def _silence(domain: DomainStatus) -> Iterator[DoctorFinding]:
    """A note for each peer at which no participant was heard.

    If none was heard outside at all: a single note.
    """
    fix = (
        "start a participant there with the same ROS_DOMAIN_ID, and "
        f"{how_to('publish for UDP')}. Cyclone DDS with multicast takes ports that the proxy does "
        f'not know: {how_to("LAN relay")}, or add <Peer address="{domain.discovery}"/> to the '
        "CYCLONEDDS_URI of the participant"
    )
    if not domain.outside:
        text = "no participant outside has been heard. The proxy receives announcements from "
        text += f"outside at {domain.discovery}"
        yield note("outside", f"domain {domain.domain}", text, fix)
        return
    heard = {participant.address for participant in domain.outside}
    for peer in domain.peers:
        target = parse_host_port(peer)
        host = target.host if target else peer
        # A peer with addresses of both families may announce itself by one family alone.
        is_main_family = (":" in host) == domain.discovery.startswith("[")
        if host not in heard and is_main_family:
            yield note("outside", f"peer {peer}", "no participant at this peer has been heard", fix)


def _finding(problem: DomainProblem) -> DoctorFinding:
    report = error if problem.grave else warning
    return report(problem.check, problem.subject, problem.text, problem.fix)


def _heard(
    participant: HeardParticipant, domains: tuple[DomainStatus, ...], known: set[str]
) -> Iterator[DoctorFinding]:
    """The finding about a participant on a network inside that the proxy has not heard.

    ``known``: the GUID prefixes of the participants that the proxy has heard.
    """
    served = {domain.domain: domain for domain in domains}
    label = f"participant at {participant.address} ({participant.vendor}, inside)"
    if participant.domain not in served:
        text = f"{label}: is in domain {participant.domain}, but this proxy serves "
        text += f"{'domain' if len(served) == 1 else 'domains'} {listed(map(str, served))}"
        fix = (
            f"set ROS_DOMAIN_ID={domains[0].domain} for the participant, or "
            f"{how_to('domain', domain=participant.domain)}"
        )
        yield warning(OTHER_DOMAIN, participant.guid_prefix, text, fix)
    elif participant.guid_prefix in known:
        return
    elif participant.address in served[participant.domain].unselected:
        text = f"{label}: is not served, since the operator has not selected this address"
        yield warning(UNSELECTED, participant.guid_prefix, text, how_to("selected participant"))
    else:
        text = f"{label}: answers the doctor, but does not announce itself to the network: its "
        text += "discovery range is its own machine. So the proxy does not hear the participant"
        fix = "where the participant runs: set ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET and unset "
        fix += "ROS_LOCALHOST_ONLY; or set ROS_STATIC_PEERS to the proxy's address"
        yield warning(OWN_MACHINE, participant.guid_prefix, text, fix)


def _name_in_domains(name: str, domains: tuple[DomainStatus, ...]) -> Iterator[DoctorFinding]:
    """The findings about a topic or service: participants, and whether the two sides match."""
    participants = [p for domain in domains for side in _sides(domain) for p in side]
    named = [(*p.publishes, *p.subscribes, *p.services, *p.nodes) for p in participants]
    if not any(name in names for names in named):
        text = "no participant has a topic, service or node of this name"
        yield error(
            UNKNOWN_NAME, name, text, f"compare with the names in the status: {how_to('status')}"
        )
    for domain in domains:
        yield from _name_in_domain(domain, name)


def _name_in_domain(domain: DomainStatus, name: str) -> Iterator[DoctorFinding]:
    participants = [(p, side is domain.inside) for side in _sides(domain) for p in side]
    publishers = [p for p in participants if name in p[0].publishes]
    subscribers = [p for p in participants if name in p[0].subscribes]
    for participant, is_inside in participants:
        yield from _of_participant(participant, is_inside, name)
    for own_side, other_side, lacks in (
        (publishers, subscribers, "subscribes to"),
        (subscribers, publishers, "publishes"),
    ):
        if own_side and not other_side:
            text = f"no participant {lacks} {name}"
            yield note("topic", name, text, "check the name; check that the other program runs")
    sides = {is_inside for _, is_inside in (*publishers, *subscribers)}
    if publishers and subscribers and len(sides) == 1:
        text = "all publishers and subscribers are on one side, so no message passes the proxy"
        yield note("topic", name, text)
    troubled = {problem.subject for problem in domain_problems(domain) if problem.grave}
    mismatched = {(m.writer, m.reader) for m in domain.mismatches if m.name == name}
    pairs = product(publishers, subscribers)
    for (participant, from_inside), (peer, to_inside) in islice(pairs, MOST_PAIRS):
        guids = participant.guid_prefix, peer.guid_prefix
        if from_inside is not to_inside and guids not in mismatched and not troubled & {*guids}:
            text = (
                f"the publisher {guids[0]} {participant_label(participant, from_inside)} and "
                f"the subscription {guids[1]} {participant_label(peer, to_inside)} match"
            )
            yield ok("topic", name, text)


def _of_participant(
    participant: ParticipantStatus, is_inside: bool, name: str
) -> Iterator[DoctorFinding]:
    """The findings that a participant has a service or a node of this name."""
    shown = f"participant {participant.guid_prefix} {participant_label(participant, is_inside)}"
    if name in participant.services:
        yield ok("service", name, f"served by {shown}")
    if name in participant.nodes:
        yield ok("node", name, f"a node of {shown}")


def _sides(domain: DomainStatus) -> tuple[tuple[ParticipantStatus, ...], ...]:
    return domain.inside, domain.outside


def _counted(participants: tuple[ParticipantStatus, ...]) -> str:
    vendors = sorted({p.vendor for p in participants})
    return f"{plural(len(participants), 'participant')} of {listed(vendors)}"
