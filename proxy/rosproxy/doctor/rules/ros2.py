"""Rules about ROS 2: whether participants of both sides can meet, as far as the proxy sees it.

Most of it the proxy knows itself (`rosproxy.admin.domain_problems`). The doctor knows besides who
is on the networks inside and is not heard by the proxy, and which topics and services it is about.
"""

from collections.abc import Iterator

from rosproxy.admin.domain_problems import DomainProblem, domain_problems, named
from rosproxy.admin.findings import DoctorFinding, error, note, ok, warning
from rosproxy.admin.status_document import DomainStatus, ParticipantStatus
from rosproxy.doctor.facts import DoctorFacts, HeardParticipant
from rosproxy.telemetry.text import listed, plural

RECENT = 120.0
"""Seconds for which something that was refused is told; what goes on is noted again sooner."""
SETTLED = 10.0
"""Seconds after its start in which the proxy may still ask those that it has heard for their ports
(`rosproxy.ros2.discovery.domain`), and does not tell of them yet."""
_REFUSED = {
    "refused: no locator": (
        "tcp: unset FASTDDS_BUILTIN_TRANSPORTS there; loopback: ROS_AUTOMATIC_DISCOVERY_RANGE="
        "SUBNET; elsewhere: it is behind NAT, put a proxy there; missing: give it UDPv4"
    ),
    "refused: not a peer": "give its address as --ros2-peer, if it is to meet those inside",
    "refused: participants": "rosproxy status lists them; docs/reference/limits.md has the bounds",
}
"""What mends what the proxy has refused, by the subject of the problem."""


def check(facts: DoctorFacts) -> list[DoctorFinding]:
    """What is to be said of the domains."""
    domains = facts.proxy.domains
    found = [finding for domain in domains for finding in _domain(domain)]
    if facts.proxy.uptime >= SETTLED:
        found += [finding for one in facts.heard for finding in _heard(one, domains)]
    found += [
        warning("refused", one.subject, one.text, _REFUSED[one.subject])
        for one in facts.proxy.problems
        if domains and one.subject in _REFUSED and one.age < RECENT
    ]
    if not facts.proxy.settings.for_ros1:
        found += [finding for name in facts.names for finding in _asked_for(name, domains)]
    return found


def _domain(domain: DomainStatus) -> Iterator[DoctorFinding]:
    subject = f"domain {domain.domain}"
    if not domain.peers and not domain.ear:
        text = "nobody outside is told of participants inside"
        yield error(
            "announcing", subject, text, "give --ros2-peer, or run rosproxy ear (--ros2-ear)"
        )
    if not domain.inside:
        text = "no participant inside has been heard"
        fix = f"put the nodes on a network of the proxy's, with ROS_DOMAIN_ID={domain.domain} and "
        fix += (
            "ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET; without multicast there, set ROS_STATIC_PEERS "
        )
        fix += "to the proxy's address for them; with RMW_IMPLEMENTATION=rmw_zenoh_cpp they don't "
        yield warning("inside", subject, text, fix + "use DDS, and the proxy can't carry them")
    else:
        yield ok("inside", subject, f"inside: {_counted(domain.inside)}")
    if not domain.outside:
        text = f"no participant outside has been heard; announced at {domain.discovery}"
        fix = "start one there with the same ROS_DOMAIN_ID; publish the range for UDP; Cyclone DDS "
        yield note("outside", subject, text, fix + "outside needs the ear")
    else:
        yield ok("outside", subject, f"outside: {_counted(domain.outside)}")
    yield from map(_finding, domain_problems(domain))


def _finding(problem: DomainProblem) -> DoctorFinding:
    say = error if problem.grave else warning
    return say(problem.check, problem.subject, problem.text, problem.fix)


def _heard(one: HeardParticipant, domains: tuple[DomainStatus, ...]) -> Iterator[DoctorFinding]:
    """What is to be said of a participant on a network inside that the proxy has not heard."""
    served = [domain.domain for domain in domains]
    known = {seen.guid_prefix for domain in domains for seen in (*domain.inside, *domain.outside)}
    where = f"at {one.address} ({one.vendor}, inside)"
    if one.domain not in served:
        text = f"{where}: it is in domain {one.domain}; this proxy serves "
        fix = (
            f"ROS_DOMAIN_ID={served[0]} for it, or --ros2-domain {one.domain} for the proxy as well"
        )
        yield warning("domain", one.guid_prefix, text + listed(map(str, served)), fix)
    elif one.guid_prefix not in known:
        text = f"{where}: it answers, but does not announce itself to the network, so that the "
        text += "proxy does not hear it: its discovery range is its own machine"
        fix = (
            "where it runs: ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET, and unset ROS_LOCALHOST_ONLY; or "
        )
        fix += "ROS_STATIC_PEERS with the proxy's address"
        yield warning("range", one.guid_prefix, text, fix)


def _asked_for(name: str, domains: tuple[DomainStatus, ...]) -> Iterator[DoctorFinding]:
    """Who has a topic or service, and whether the two sides match."""
    everybody = [one for domain in domains for side in _sides(domain) for one in side]
    if not any(name in (*one.publishes, *one.subscribes, *one.services) for one in everybody):
        text = "no participant has a topic or service of this name"
        yield error("name", name, text, "compare with those that rosproxy status lists")
    for domain in domains:
        yield from _name_in(domain, name)


def _name_in(domain: DomainStatus, name: str) -> Iterator[DoctorFinding]:
    everybody = [(one, side is domain.inside) for side in _sides(domain) for one in side]
    publishers = [one for one in everybody if name in one[0].publishes]
    subscribers = [one for one in everybody if name in one[0].subscribes]
    for one, is_inside in everybody:
        if name in one.services:
            yield ok("service", name, f"served by {one.guid_prefix} {named(one, is_inside)}")
    for these, others, lack in (
        (publishers, subscribers, "subscribes to"),
        (subscribers, publishers, "publishes"),
    ):
        if these and not others:
            yield note("topic", name, f"nobody {lack} it", "see the name, and that it runs")
    pairs = [(one, other) for one in publishers for other in subscribers]
    if pairs and all(one[1] is other[1] for one, other in pairs):
        text = "all that have it are on one side, so that it does not pass the proxy"
        yield note("topic", name, text)
    troubled = {problem.subject for problem in domain_problems(domain) if problem.grave}
    bad = {(one.writer, one.reader) for one in domain.mismatches if one.name == name}
    for (one, here), (other, there) in pairs:
        both = one.guid_prefix, other.guid_prefix
        if here is not there and both not in bad and not troubled & {*both}:
            text = f"{both[0]} {named(one, here)} to {both[1]} {named(other, there)}: they match"
            yield ok("topic", name, text)


def _sides(domain: DomainStatus) -> tuple[tuple[ParticipantStatus, ...], ...]:
    return domain.inside, domain.outside


def _counted(participants: tuple[ParticipantStatus, ...]) -> str:
    vendors = sorted({one.vendor for one in participants})
    return f"{plural(len(participants), 'participant')} of {', '.join(vendors)}"
