"""ROS 2 in the document of a proxy: participants, and what is announced on both sides.

User data is not read, so that neither messages nor their rate are known of a topic: the bytes are
those of a participant's ports.
"""

from collections.abc import Iterator

from rosproxy.admin.domain_problems import DomainProblem, domain_problems, mismatch_problems
from rosproxy.admin.findings import DoctorFinding
from rosproxy.admin.status_document import DomainStatus, ParticipantStatus, ProxyStatus
from rosproxy.doctor.facts import DoctorFacts
from rosproxy.doctor.rules.ros2 import check
from rosproxy.net.addresses import is_loopback
from rosproxy.page.document import (
    BROKEN,
    CONTAINER,
    HOST,
    OK,
    QUIET,
    ROBOT,
    WARNING,
    PageLink,
    PageNode,
    is_quiet_service,
    rounded,
    short,
    told,
)
from rosproxy.ros2.registry.participants import LeaseKind

_QUIET_ENDINGS = (
    *("/describe_parameters", "/get_parameters", "/get_parameter_types", "/list_parameters"),
    *("/set_parameters", "/set_parameters_atomically", "/get_type_description"),
)
"""Services that every node of ROS 2 has."""


def graph(status: ProxyStatus) -> tuple[dict[str, PageNode], list[PageLink]]:
    """The participants of all domains, and the links between them."""
    nodes: dict[str, PageNode] = {}
    links: list[PageLink] = []
    for domain in status.domains:
        problems = {one.subject: one for one in domain_problems(domain)}
        for side in (domain.inside, domain.outside):
            for one in side:
                node = _node(one, side is domain.inside, problems.get(one.guid_prefix))
                nodes[_key(domain, one)] = node
        links += _links(domain, problems)
    return nodes, links


def findings(status: ProxyStatus) -> list[DoctorFinding]:
    """What the doctor says of the domains and is shown at no participant."""
    shown = {one.guid_prefix for each in status.domains for one in (*each.inside, *each.outside)}
    return [one for one in check(DoctorFacts(status=status)) if one.subject not in shown]


def _key(domain: DomainStatus, one: ParticipantStatus) -> str:
    return f"{domain.domain} {one.guid_prefix}"


def _node(one: ParticipantStatus, inside: bool, problem: DomainProblem | None) -> PageNode:
    data = [lease for lease in one.leases if lease.kind == LeaseKind.DATA.value]
    outside = HOST if is_loopback(one.address) else ROBOT
    return PageNode(
        CONTAINER if inside else outside,
        "participant",
        short(f"{one.address} {one.guid_prefix[-11:]}"),
        _state(problem),
        told(problem.text) if problem else "",
        told(problem.fix) if problem else "",
        short(f"{one.address}, {one.vendor}"),
        ", ".join(str(lease.port) for lease in one.leases),
        rounded(sum(lease.rate for lease in data)) if data else None,
    )


def _state(problem: DomainProblem | None) -> str:
    if problem is None:
        return OK
    return BROKEN if problem.grave else WARNING


def _links(domain: DomainStatus, problems: dict[str, DomainProblem]) -> Iterator[PageLink]:
    yield from _crossing(domain, domain.inside, domain.outside, problems)
    yield from _crossing(domain, domain.outside, domain.inside, problems)
    for one in domain.inside:
        for service in one.services:
            quiet = is_quiet_service(service) or service.endswith(_QUIET_ENDINGS)
            problem = problems.get(one.guid_prefix)
            yield PageLink(
                "service", short(service), _key(domain, one), state=_state(problem), quiet=quiet
            )


def _crossing(
    domain: DomainStatus,
    givers: tuple[ParticipantStatus, ...],
    takers: tuple[ParticipantStatus, ...],
    problems: dict[str, DomainProblem],
) -> Iterator[PageLink]:
    """The topics that cross the boundary in one direction."""
    takers_of: dict[str, list[ParticipantStatus]] = {}
    for taker in takers:
        for topic in taker.subscribes:
            takers_of.setdefault(topic, []).append(taker)
    apart = {(one.name, one.writer, one.reader): why for one, why in mismatch_problems(domain)}
    for giver in givers:
        for topic in giver.publishes:
            for taker in takers_of.get(topic, ()):
                problem = problems.get(giver.guid_prefix) or problems.get(taker.guid_prefix)
                problem = problem or apart.get((topic, giver.guid_prefix, taker.guid_prefix))
                yield _link(domain, topic, giver, taker, problem)


def _link(
    domain: DomainStatus,
    topic: str,
    giver: ParticipantStatus,
    taker: ParticipantStatus,
    problem: DomainProblem | None,
) -> PageLink:
    state = _state(problem)
    data = [lease for lease in taker.leases if lease.kind == LeaseKind.DATA.value]
    return PageLink(
        "topic",
        short(topic),
        _key(domain, giver),
        _key(domain, taker),
        carried=data[0].plane if data and state != BROKEN else "",
        port=data[0].port if data else None,
        state=state,
        text=told(problem.text) if problem else "",
        fix=told(problem.fix) if problem else "",
        quiet=topic in QUIET,
    )
