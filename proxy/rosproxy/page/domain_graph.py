"""ROS 2 in the document of a proxy: participants, and what is announced on both sides.

User data is not read, so that neither messages nor their rate are known of a topic: the bytes are
those of a participant's ports.
"""

from collections.abc import Iterator

from rosproxy.admin.doctor_finding import DoctorFinding
from rosproxy.admin.status_document import DomainStatus, ParticipantStatus, ProxyStatus
from rosproxy.doctor.facts import DoctorFacts
from rosproxy.doctor.rules.participant import check
from rosproxy.net.addresses import is_loopback
from rosproxy.page.page_document import (
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
    shown_name,
    shown_text,
)
from rosproxy.ros2.domain_problems import DomainProblem, domain_problems, mismatch_problems
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
        problems = {problem.subject: problem for problem in domain_problems(domain)}
        for side in (domain.inside, domain.outside):
            for participant in side:
                node = _node(
                    participant, side is domain.inside, problems.get(participant.guid_prefix)
                )
                nodes[_key(domain, participant)] = node
        links += _links(domain, problems, "" if domain.direction == "both" else "direct")
    return nodes, links


def findings(status: ProxyStatus) -> list[DoctorFinding]:
    """What the doctor says of the domains, but for what is shown at participants."""
    shown = {p.guid_prefix for domain in status.domains for p in (*domain.inside, *domain.outside)}
    return [f for f in check(DoctorFacts(status=status)) if f.subject not in shown]


def _key(domain: DomainStatus, participant: ParticipantStatus) -> str:
    return f"{domain.domain} {participant.guid_prefix}"


def _node(
    participant: ParticipantStatus, is_inside: bool, problem: DomainProblem | None
) -> PageNode:
    data = [lease for lease in participant.leases if lease.kind == LeaseKind.DATA.value]
    outside_lane = HOST if is_loopback(participant.address) else ROBOT
    return PageNode(
        CONTAINER if is_inside else outside_lane,
        "participant",
        shown_name(f"{participant.address} {_distinguishing(participant.guid_prefix)}"),
        _state(problem),
        shown_text(problem.text) if problem else "",
        shown_text(problem.fix) if problem else "",
        shown_name(f"{participant.address}, {participant.vendor}"),
        ", ".join(str(lease.port) for lease in participant.leases),
        rounded(sum(lease.rate for lease in data)) if data else None,
    )


def _distinguishing(guid_prefix: str) -> str:
    """The part of a GUID prefix in which participants of a machine differ.

    The first four bytes are the vendor's and, of Fast DDS, the machine's. Then it has the process,
    and in the last four the participant of that, which are 0 for the only one.
    """
    return guid_prefix[len("01.0f.aa.bb.") :].removesuffix(".00.00.00.00")


def _state(problem: DomainProblem | None) -> str:
    if problem is None:
        return OK
    return BROKEN if problem.grave else WARNING


def _links(
    domain: DomainStatus, problems: dict[str, DomainProblem], way_out: str
) -> Iterator[PageLink]:
    """The links of a domain; ``way_out`` is how what goes by no port of the proxy's is carried."""
    for writers, readers in ((domain.inside, domain.outside), (domain.outside, domain.inside)):
        way = way_out if writers is domain.inside else ""
        yield from _crossing(domain, writers, readers, problems, way)
    for participant in domain.inside:
        for service in participant.services:
            quiet = is_quiet_service(service) or service.endswith(_QUIET_ENDINGS)
            problem = problems.get(participant.guid_prefix)
            yield PageLink(
                "service",
                shown_name(service),
                _key(domain, participant),
                state=_state(problem),
                text=shown_text(problem.text) if problem else "",
                fix=shown_text(problem.fix) if problem else "",
                quiet=quiet,
            )


def _crossing(
    domain: DomainStatus,
    writers: tuple[ParticipantStatus, ...],
    readers: tuple[ParticipantStatus, ...],
    problems: dict[str, DomainProblem],
    way: str,
) -> Iterator[PageLink]:
    """The topics that cross the boundary in one direction."""
    readers_by_topic: dict[str, list[ParticipantStatus]] = {}
    for reader in readers:
        for topic in reader.subscribes:
            readers_by_topic.setdefault(topic, []).append(reader)
    mismatched = {(m.name, m.writer, m.reader): p for m, p in mismatch_problems(domain)}
    for writer in writers:
        for topic in writer.publishes:
            for reader in readers_by_topic.get(topic, ()):
                problem = problems.get(writer.guid_prefix) or problems.get(reader.guid_prefix)
                problem = problem or mismatched.get((topic, writer.guid_prefix, reader.guid_prefix))
                yield _link(domain, topic, (writer, reader), problem, way)


def _link(
    domain: DomainStatus,
    topic: str,
    ends: tuple[ParticipantStatus, ParticipantStatus],
    problem: DomainProblem | None,
    way: str,
) -> PageLink:
    writer, reader = ends
    state = _state(problem)
    data = [lease for lease in reader.leases if lease.kind == LeaseKind.DATA.value]
    return PageLink(
        "topic",
        shown_name(topic),
        _key(domain, writer),
        _key(domain, reader),
        carried="" if state == BROKEN else data[0].plane if data else way,
        port=data[0].port if data else None,
        state=state,
        text=shown_text(problem.text) if problem else "",
        fix=shown_text(problem.fix) if problem else "",
        quiet=topic in QUIET,
    )
