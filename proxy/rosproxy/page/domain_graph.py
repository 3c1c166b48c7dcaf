"""ROS 2 in the document of a proxy: participants, topics and services of both sides.

The proxy does not read messages, so the document has no count and no rate of messages. The proxy
measures the ports of a participant instead: all links to the participant share these measures.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence

from msgspec.structs import replace

from rosproxy.doctor.facts import DoctorFacts
from rosproxy.doctor.rules.participant import check
from rosproxy.doctor.rules.policy import hidden_finding
from rosproxy.page.measures import FLOW_PERIOD_S, Measures
from rosproxy.page.page_document import (
    BROKEN,
    CONTAINER,
    HOST,
    OK,
    QUIET,
    ROBOT,
    WARNING,
    Json,
    PageLink,
    PageNode,
    is_quiet_service,
    rounded,
    shown_name,
    shown_text,
)
from rosproxy.ros2.domain_problems import DomainProblem, domain_problems, mismatch_problems
from rosproxy.ros2.registry.participants import TrafficKind
from rosproxy.shared.addresses import is_loopback
from rosproxy.shared.documents.doctor_finding import DoctorFinding
from rosproxy.shared.documents.status_document import (
    DomainStatus,
    LocatorStatus,
    ParticipantStatus,
    ProxyStatus,
)

_QUIET_ENDINGS = (
    *("/describe_parameters", "/get_parameters", "/get_parameter_types", "/list_parameters"),
    *("/set_parameters", "/set_parameters_atomically", "/get_type_description"),
)
"""Endings of the services that every node of ROS 2 has."""
_QUIET_TOPICS = QUIET | {"ros_discovery_info"}
"""On ros_discovery_info, participants announce the ROS 2 nodes that each participant has."""
KERNEL = "kernel"
Key = tuple[str, str, str, str]
"""A link: kind, name, GUID prefix of the source, GUID prefix of the target."""


def graph(
    status: ProxyStatus, measures: Measures, now: float, epoch: float
) -> tuple[dict[str, PageNode], list[PageLink]]:
    """The participants of all domains, and the links between them.

    ``now`` and ``epoch`` as for `rosproxy.page.graph_document.graph_document`.
    """
    nodes: dict[str, PageNode] = {}
    links: list[PageLink] = []
    for domain in status.domains:
        problems = {problem.subject: problem for problem in domain_problems(domain)}
        labels = _labels((*domain.inside, *domain.outside))
        for side in (domain.inside, domain.outside):
            for participant in side:
                problem = problems.get(participant.guid_prefix)
                node = _node(domain, participant, side is domain.inside, problem)
                node = replace(node, label=labels[participant.guid_prefix])
                nodes[_key(domain, participant.guid_prefix)] = node
        made = _links(domain, problems, _hidden(status))
        links += _measured(domain, made, measures, now, epoch)
    return nodes, links


def received(status: ProxyStatus) -> dict[str, int]:
    """The datagrams of user data that the proxy has passed to each participant, by its key.

    Without ``--direction both``, user data to outside does not pass the proxy.
    """
    return {
        _key(domain, participant.guid_prefix): sum(
            locator.user_datagrams for locator in _user_data_ports(participant)
        )
        for domain in status.domains
        for participant in (
            *domain.inside,
            *(domain.outside if domain.direction == "both" else ()),
        )
    }


def findings(status: ProxyStatus) -> list[DoctorFinding]:
    """The doctor's findings on the domains that no participant and no link shows."""
    shown = {p.guid_prefix for domain in status.domains for p in (*domain.inside, *domain.outside)}
    at_links = {
        (problem.subject, problem.text)
        for domain in status.domains
        for problem in _mismatches(domain).values()
    }
    return [
        f
        for f in check(DoctorFacts(status=status))
        if f.subject not in shown and (f.subject, f.text) not in at_links
    ]


def _key(domain: DomainStatus, guid_prefix: str) -> str:
    return f"{domain.domain} {guid_prefix}"


def _user_data_ports(participant: ParticipantStatus) -> list[LocatorStatus]:
    """The ports of the proxy at which user data for a participant arrives.

    Cyclone DDS has the same port for discovery and user data. Then this port counts.
    """
    data = [
        locator for locator in participant.leases if locator.kind == TrafficKind.USER_DATA.value
    ]
    return data or [*participant.leases]


def _measured(
    domain: DomainStatus, links: Iterable[PageLink], measures: Measures, now: float, epoch: float
) -> Iterator[PageLink]:
    """The links, with the measures of the participants to which they lead.

    No measures for services, for quiet and broken links, and for links that do not pass the proxy.
    """
    groups: dict[str, list[PageLink]] = {}
    published: Counter[str] = Counter()
    for link in links:
        is_live = link.kind == "topic" and not link.quiet and link.state != BROKEN
        published[link.source] += is_live
        if is_live and link.port:
            groups.setdefault(link.target, []).append(link)
        else:
            yield link
    for side, others in ((domain.inside, domain.outside), (domain.outside, domain.inside)):
        for participant in side:
            key = _key(domain, participant.guid_prefix)
            if group := groups.get(key):
                last = measures.participant_last(key)
                since = None if last is None else now - last
                measured = _measures_of(participant, group, published[key], len(others), since)
                seen = None if measured.pop("is_active") or last is None else round(epoch + last)
                yield from (replace(link, since=seen, **measured) for link in group)


def _measures_of(
    participant: ParticipantStatus,
    group: list[PageLink],
    published: int,
    others: int,
    since: float | None,
) -> Json:
    """The measures that all links in ``group`` to a participant share; ``is_active``: data comes.

    ``published`` is the number of links from the participant, one for each topic and reader. If the
    kernel forwards, the measures also have the acknowledgements for these links. ``others`` is the
    number of participants on the other side. The last data came ``since`` seconds ago; None: not
    known.

    A datagram may belong to any link or service of the participant. So ``flows`` is set only if all
    data comes from one participant.
    """
    ports = _user_data_ports(participant)
    services = sum(not is_quiet_ros2_service(name) for name in participant.services)
    acknowledged = published if any(locator.plane == KERNEL for locator in ports) else 0
    shared = len(group) + services + acknowledged
    datagrams = sum(locator.user_datagram_rate for locator in ports)
    is_active = datagrams > 0 or (since is not None and since < FLOW_PERIOD_S)
    sources = others if services else len({link.source for link in group})
    # False: data has come after the latest sample of the rates, or comes less often than a sample.
    is_sampled = datagrams > 0 or not is_active
    return {
        "is_active": is_active,
        "rate": rounded(sum(locator.user_rate for locator in ports)) if is_sampled else None,
        "datagrams": rounded(datagrams) if is_sampled else None,
        "flows": is_active and not acknowledged and sources == 1,
        "shared": shared if shared > 1 else 0,
    }


def is_quiet_ros2_service(name: str) -> bool:
    """Whether every node of ROS 2 has such a service."""
    return is_quiet_service(name) or name.endswith(_QUIET_ENDINGS)


def _node(
    domain: DomainStatus,
    participant: ParticipantStatus,
    is_inside: bool,
    problem: DomainProblem | None,
) -> PageNode:
    is_passed = is_inside or domain.direction == "both"
    data = _user_data_ports(participant) if is_passed else []
    outside_lane = HOST if is_loopback(participant.address) else ROBOT
    return PageNode(
        CONTAINER if is_inside else outside_lane,
        "participant",
        detail=_detail(participant),
        state=_state(problem),
        text=shown_text(problem.text) if problem else "",
        fix=shown_text(problem.fix) if problem else "",
        address=shown_name(f"{participant.address}, {participant.vendor}"),
        ports=", ".join(str(locator.port) for locator in participant.leases),
        rate=rounded(sum(locator.rate for locator in data)) if data else None,
    )


def _labels(participants: Iterable[ParticipantStatus]) -> dict[str, str]:
    """The label of each participant of a domain, by GUID prefix: its nodes, else its address.

    If several participants without known nodes have the same address, they are numbered.
    """
    participants = sorted(participants, key=lambda participant: participant.guid_prefix)
    unnamed = Counter(p.address for p in participants if not p.nodes)
    numbers: Counter[str] = Counter()
    labels = {}
    for participant in participants:
        label = _node_label(participant.nodes) if participant.nodes else participant.address
        if not participant.nodes and unnamed[participant.address] > 1:
            numbers[participant.address] += 1
            label += f" #{numbers[participant.address]}"
        labels[participant.guid_prefix] = shown_name(label)
    return labels


def _node_label(nodes: Sequence[str]) -> str:
    first, *others = nodes
    return f"{first} and {len(others)} more" if len(others) > 1 else " and ".join(nodes)


def _detail(participant: ParticipantStatus) -> str:
    """The text of a selected participant: its nodes if there are several, and the GUID prefix."""
    nodes = f"nodes {', '.join(participant.nodes)}; " if len(participant.nodes) > 1 else ""
    return shown_text(f"{nodes}participant {participant.guid_prefix}")


def _state(problem: DomainProblem | None) -> str:
    if problem is None:
        return OK
    return BROKEN if problem.grave else WARNING


def _mismatches(domain: DomainStatus) -> dict[Key, DomainProblem]:
    """The mismatches of QoS or type, by the link that shows the mismatch."""
    participants = {p.guid_prefix: p for p in (*domain.inside, *domain.outside)}
    unknown = ParticipantStatus()
    mismatches: dict[Key, DomainProblem] = {}
    for pair, problem in mismatch_problems(domain):
        writer = participants.get(pair.writer, unknown)
        reader = participants.get(pair.reader, unknown)
        if pair.kind == "topic":
            ends = (writer, reader)
            has_link = pair.name in {*writer.publishes} & {*reader.subscribes}
        else:  # both ends of a service write and read
            ends = (reader, writer) if pair.name in reader.services else (writer, reader)
            has_link = pair.name in ends[0].services and ends[1] is not unknown
        if has_link:
            mismatches[pair.kind, pair.name, ends[0].guid_prefix, ends[1].guid_prefix] = problem
    return mismatches


def _hidden(status: ProxyStatus) -> dict[tuple[str, str, str], DomainProblem]:
    """What the policy hides from outside, by kind, name and the GUID prefix of the participant."""
    hidden = {}
    for entry in status.policy.hidden if status.policy else ():
        finding = hidden_finding(entry)
        problem = DomainProblem(finding.check, entry.name, finding.text, finding.fix, grave=False)
        hidden[entry.kind, entry.name, entry.node] = problem
    return hidden


def _links(
    domain: DomainStatus,
    problems: Mapping[str, DomainProblem],
    hidden: Mapping[tuple[str, str, str], DomainProblem],
) -> Iterator[PageLink]:
    """The links of a domain. ``problems`` by GUID prefix, ``hidden`` as `_hidden` returns it."""
    mismatches = _mismatches(domain)
    for writers, readers in ((domain.inside, domain.outside), (domain.outside, domain.inside)):
        is_passed = writers is domain.outside or domain.direction == "both"
        for topic, writer, reader in _crossing(writers, readers):
            key = ("topic", topic, writer.guid_prefix, reader.guid_prefix)
            denial = hidden.get(("publish", topic, writer.guid_prefix)) or hidden.get(
                ("subscribe", topic, reader.guid_prefix)
            )
            problem = _worst(
                problems.get(writer.guid_prefix),
                problems.get(reader.guid_prefix),
                denial,
                mismatches.get(key),
            )
            link = _topic_link(domain, topic, (writer, reader), problem, is_passed)
            yield replace(link, carried="", port=None) if denial else link
    for participant in domain.inside:
        for service in participant.services:
            yield _marked(
                PageLink(
                    "service",
                    shown_name(service),
                    _key(domain, participant.guid_prefix),
                    quiet=is_quiet_ros2_service(service),
                ),
                _worst(
                    problems.get(participant.guid_prefix),
                    hidden.get(("serve", service, participant.guid_prefix)),
                ),
            )
    # A service has a link to a client only if client and server do not match.
    for (kind, name, server, client), problem in mismatches.items():
        if kind == "service":
            ends = _key(domain, server), _key(domain, client)
            yield _marked(PageLink("service", shown_name(name), *ends), problem)


def _crossing(
    writers: tuple[ParticipantStatus, ...], readers: tuple[ParticipantStatus, ...]
) -> Iterator[tuple[str, ParticipantStatus, ParticipantStatus]]:
    """The topics that cross the boundary in one direction, each with a writer and a reader."""
    readers_by_topic: dict[str, list[ParticipantStatus]] = {}
    for reader in readers:
        for topic in reader.subscribes:
            readers_by_topic.setdefault(topic, []).append(reader)
    for writer in writers:
        for topic in writer.publishes:
            for reader in readers_by_topic.get(topic, ()):
                yield topic, writer, reader


def _worst(*problems: DomainProblem | None) -> DomainProblem | None:
    """The first grave problem, else the first problem; None without a problem."""
    present = [problem for problem in problems if problem]
    return next((problem for problem in present if problem.grave), next(iter(present), None))


def _topic_link(
    domain: DomainStatus,
    topic: str,
    ends: tuple[ParticipantStatus, ParticipantStatus],
    problem: DomainProblem | None,
    is_passed: bool,
) -> PageLink:
    """A topic between two participants. ``is_passed``: the user data passes the proxy."""
    writer, reader = ends
    port = next(iter(_user_data_ports(reader)), None) if is_passed else None
    carried = (port.plane if port else "") if is_passed else "direct"
    link = PageLink(
        "topic",
        shown_name(topic),
        _key(domain, writer.guid_prefix),
        _key(domain, reader.guid_prefix),
        carried="" if _state(problem) == BROKEN else carried,
        port=port.port if port else None,
        quiet=topic in _QUIET_TOPICS,
    )
    return _marked(link, problem)


def _marked(link: PageLink, problem: DomainProblem | None) -> PageLink:
    """The link with the state, text and fix of a problem, if any."""
    text, fix = (problem.text, problem.fix) if problem else ("", "")
    return replace(link, state=_state(problem), text=shown_text(text), fix=shown_text(fix))
