"""Rules about ROS 2: whether participants of both sides can meet, as far as the proxy sees it.

Most of it the proxy knows itself (`rosproxy.ros2.domain_problems`). The doctor knows besides who
is on the networks inside but not heard by the proxy, and which topics and services were asked for.
"""

from collections.abc import Iterator

from rosproxy.admin.doctor_finding import UNKNOWN_NAME, DoctorFinding, error, note, ok, warning
from rosproxy.admin.status_document import DomainStatus, ParticipantStatus
from rosproxy.doctor.facts import DoctorFacts, HeardParticipant
from rosproxy.net.addresses import parse_host_port
from rosproxy.ros2.domain_problems import DomainProblem, domain_problems, participant_label
from rosproxy.telemetry.text import listed, plural

RECENT = 120.0
"""Seconds for which something that was refused is told; what goes on is noted again sooner."""
SETTLED = 10.0
"""Seconds after its start in which the proxy may still ask those that it has heard for their ports
(`rosproxy.ros2.discovery.domain`), and does not tell of them yet."""
OTHER_DOMAIN = "domain"
"""The check for a participant on a network inside that is in another domain."""
OWN_MACHINE = "range"
"""The check for a participant on a network inside that announces itself on its own machine."""
HIDDEN = "refused: hidden source"
_REFUSED = {
    "refused: no locator": (
        "tcp: unset FASTDDS_BUILTIN_TRANSPORTS there; loopback: ROS_AUTOMATIC_DISCOVERY_RANGE="
        "SUBNET; elsewhere: it is behind NAT, put a proxy there; missing: give it UDPv4"
    ),
    "refused: not a peer": "give its address as --ros2-peer, if it is to meet those inside",
    HIDDEN: (
        "rootless Docker: DOCKERD_ROOTLESS_ROOTLESSKIT_PORT_DRIVER=slirp4netns for its service; "
        "Docker Desktop: use an engine on Linux; Docker before 23.0: as root on the host "
        "conntrack -D -p udp. docs/guide/troubleshooting.md has more"
    ),
    "refused: participants": "rosproxy status lists them; docs/reference/limits.md has the bounds",
}
"""What mends what the proxy has refused, by the subject of the problem."""


def check(facts: DoctorFacts) -> list[DoctorFinding]:
    """What is to be said of the domains."""
    domains = facts.proxy.domains
    is_settled = facts.proxy.uptime >= SETTLED
    findings = [finding for domain in domains for finding in _domain(domain, is_settled)]
    if is_settled:
        findings += [
            finding for heard in facts.heard_participants for finding in _heard(heard, domains)
        ]
    findings += [
        (error if problem.subject == HIDDEN else warning)(
            "refused", problem.subject, problem.text, _REFUSED[problem.subject]
        )
        for problem in facts.proxy.problems
        if domains and problem.subject in _REFUSED and problem.age < RECENT
    ]
    if not facts.proxy.settings.for_ros1:
        findings += [finding for name in facts.names for finding in _name_in_domains(name, domains)]
    return findings


def _domain(domain: DomainStatus, is_settled: bool) -> Iterator[DoctorFinding]:
    subject = f"domain {domain.domain}"
    if not domain.peers and not domain.lan_relay:
        text = "participants inside are announced to nobody outside"
        yield error(
            "announcing",
            subject,
            text,
            "give --ros2-peer, or run rosproxy lan-relay (--ros2-lan-relay)",
        )
    if not domain.inside and not is_settled:
        text = "no participant inside has been heard yet; the proxy has just started"
        yield note("inside", subject, text, "wait some seconds")
    elif not domain.inside:
        text = "no participant inside has been heard"
        fix = f"put the nodes on a network of the proxy's, with ROS_DOMAIN_ID={domain.domain} and "
        fix += (
            "ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET; without multicast there, set ROS_STATIC_PEERS "
        )
        fix += "to the proxy's address for them; with RMW_IMPLEMENTATION=rmw_zenoh_cpp they don't "
        yield warning("inside", subject, text, fix + "use DDS, and the proxy can't carry them")
    else:
        yield ok("inside", subject, f"inside: {_counted(domain.inside)}")
    if domain.outside:
        yield ok("outside", subject, f"outside: {_counted(domain.outside)}")
    yield from _silence(domain)
    yield from map(_finding, domain_problems(domain))


def _silence(domain: DomainStatus) -> Iterator[DoctorFinding]:
    """Where outside nobody has been heard: at a peer, or anywhere."""
    fix = (
        "start one there with the same ROS_DOMAIN_ID; publish the range for UDP; Cyclone DDS takes "
        "ports of its own where it has multicast, which no peer knows: run rosproxy lan-relay "
        f'(--ros2-lan-relay), or give it <Peer address="{domain.discovery}"/> in its CYCLONEDDS_URI'
    )
    if not domain.outside:
        text = f"no participant outside has been heard; announced at {domain.discovery}"
        yield note("outside", f"domain {domain.domain}", text, fix)
        return
    heard = {participant.address for participant in domain.outside}
    for peer in domain.peers:
        target = parse_host_port(peer)
        host = target.host if target else peer
        # A name may have an address of each family, and be heard by one of them.
        is_main_family = (":" in host) == domain.discovery.startswith("[")
        if host not in heard and is_main_family:
            yield note("outside", f"peer {peer}", "no participant there has been heard", fix)


def _finding(problem: DomainProblem) -> DoctorFinding:
    report = error if problem.grave else warning
    return report(problem.check, problem.subject, problem.text, problem.fix)


def _heard(
    participant: HeardParticipant, domains: tuple[DomainStatus, ...]
) -> Iterator[DoctorFinding]:
    """What is to be said of a participant on a network inside that the proxy has not heard."""
    served = [domain.domain for domain in domains]
    prefixes = {p.guid_prefix for domain in domains for p in (*domain.inside, *domain.outside)}
    label = f"at {participant.address} ({participant.vendor}, inside)"
    if participant.domain not in served:
        text = f"{label}: it is in domain {participant.domain}; this proxy serves "
        fix = (
            f"ROS_DOMAIN_ID={served[0]} for it, or --ros2-domain {participant.domain} for the "
            "proxy as well"
        )
        yield warning(OTHER_DOMAIN, participant.guid_prefix, text + listed(map(str, served)), fix)
    elif participant.guid_prefix not in prefixes:
        text = f"{label}: it answers, but does not announce itself to the network, so that the "
        text += "proxy does not hear it: its discovery range is its own machine"
        fix = (
            "where it runs: ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET, and unset ROS_LOCALHOST_ONLY; or "
        )
        fix += "ROS_STATIC_PEERS with the proxy's address"
        yield warning(OWN_MACHINE, participant.guid_prefix, text, fix)


def _name_in_domains(name: str, domains: tuple[DomainStatus, ...]) -> Iterator[DoctorFinding]:
    """Who has a topic or service, and whether the two sides match."""
    participants = [p for domain in domains for side in _sides(domain) for p in side]
    if not any(name in (*p.publishes, *p.subscribes, *p.services) for p in participants):
        text = "no participant has a topic or service of this name"
        yield error(UNKNOWN_NAME, name, text, "compare with those that rosproxy status lists")
    for domain in domains:
        yield from _name_in_domain(domain, name)


def _name_in_domain(domain: DomainStatus, name: str) -> Iterator[DoctorFinding]:
    participants = [(p, side is domain.inside) for side in _sides(domain) for p in side]
    publishers = [p for p in participants if name in p[0].publishes]
    subscribers = [p for p in participants if name in p[0].subscribes]
    for participant, is_inside in participants:
        if name in participant.services:
            yield ok(
                "service",
                name,
                f"served by {participant.guid_prefix} {participant_label(participant, is_inside)}",
            )
    for own_side, other_side, lacks in (
        (publishers, subscribers, "subscribes to"),
        (subscribers, publishers, "publishes"),
    ):
        if own_side and not other_side:
            yield note("topic", name, f"nobody {lacks} it", "check the name, and that it runs")
    pairs = [(p, s) for p in publishers for s in subscribers]
    if pairs and all(p[1] is s[1] for p, s in pairs):
        text = "all that have it are on one side, so that it does not pass the proxy"
        yield note("topic", name, text)
    troubled = {problem.subject for problem in domain_problems(domain) if problem.grave}
    mismatched = {(m.writer, m.reader) for m in domain.mismatches if m.name == name}
    for (participant, from_inside), (peer, to_inside) in pairs:
        guids = participant.guid_prefix, peer.guid_prefix
        if from_inside is not to_inside and guids not in mismatched and not troubled & {*guids}:
            text = (
                f"{guids[0]} {participant_label(participant, from_inside)} to "
                f"{guids[1]} {participant_label(peer, to_inside)}: they match"
            )
            yield ok("topic", name, text)


def _sides(domain: DomainStatus) -> tuple[tuple[ParticipantStatus, ...], ...]:
    return domain.inside, domain.outside


def _counted(participants: tuple[ParticipantStatus, ...]) -> str:
    vendors = sorted({p.vendor for p in participants})
    return f"{plural(len(participants), 'participant')} of {', '.join(vendors)}"
