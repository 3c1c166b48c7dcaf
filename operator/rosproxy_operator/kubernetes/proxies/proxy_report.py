"""Reports on proxies: the part of a proxy's ``/status`` that the operator uses."""

from itertools import islice

from msgspec.structs import replace

from rosproxy.shared.documents.status_document import (
    ProblemStatus,
    ProxyStatus,
    ZenohLinkStatus,
    ZenohStatus,
)
from rosproxy.shared.output.problems import (
    DENIED,
    MOST_PROBLEMS,
    WOULD_BE_DENIED,
    refusal_subject,
)
from rosproxy.shared.output.text import clean
from rosproxy.shared.settings import MOST_ZENOH_HUBS, MOST_ZENOH_LINKS, MOST_ZENOH_PEERS
from rosproxy_operator.common.problem import bounded
from rosproxy_operator.common.proxy_status import (
    inside_addresses,
    leases,
    nodes_by_address,
    nodes_inside,
    participants_by_address,
)
from rosproxy_operator.kubernetes.resources.cluster import ProxyReport, ZenohReport

RECENT_S = 300.0
"""Seconds for which a problem counts after the event. The proxy keeps listing its last problems."""
_DENIAL_SUBJECTS = {refusal_subject(reason) for reason in (DENIED, WOULD_BE_DENIED)}
"""Subjects of problems by which a proxy reports denials. A denial is no fault of the proxy."""
_MOST_TEXT_CHARACTERS = 300
"""Characters that are kept of a problem or an error. The proxy may send texts of any size."""


def report(status: ProxyStatus, refusal: str = "") -> ProxyReport:
    """Return the report on a proxy that has answered with a status.

    ``refusal`` is the reason why the proxy refuses its policy, empty without a refusal.
    ``nodes`` of the report leaves out nodes that the proxy has given up.
    """
    master = status.master
    nodes = nodes_by_address(status)
    all_nodes = [node for group in nodes.values() for node in group]
    topics = {topic for node in all_nodes for topic in node.publishes + node.subscribes}
    participants = participants_by_address(status)
    for participant in (p for group in participants.values() for p in group):
        topics.update(participant.publishes + participant.subscribes)
    for inside in nodes_inside(status):
        topics.update(inside.publishes + inside.subscribes)
    up = master.up or "1" not in status.settings.ros
    problems = [f"{p.subject}: {p.text}" for p in status.problems if _is_reported(p)]
    return ProxyReport(
        answered=True,
        master_up=up,
        error="" if up else short(master.error or "the proxy has not asked the master yet"),
        participants={
            address: tuple(p.guid_prefix for p in group) for address, group in participants.items()
        },
        leases=leases(status),
        nodes={
            address: tuple(sorted({name for node in group for name in node.nodes}))
            for address, group in nodes.items()
        },
        topics=frozenset(topics),
        refusal=refusal,
        # A proxy has no more problems than these. Each becomes a finding, and some an Event.
        problems=tuple(map(short, problems[-MOST_PROBLEMS:])),
        range_probe=replace(status.range_probe, age=0.0) if status.range_probe else None,
        unregistered_addresses=inside_addresses(status) - nodes.keys() - participants.keys(),
        zenoh=_zenoh_report(status) if status.zenoh else None,
        retired=status.retired,
    )


def _zenoh_report(status: ProxyStatus) -> ZenohReport:
    zenoh = status.zenoh or ZenohStatus()
    peers = (link for link in zenoh.links if link.is_to_router)
    sites = (link for link in zenoh.links if link.is_to_site)
    hubs = (link for link in zenoh.links if link.hub)
    return ZenohReport(
        nodes=tuple(sorted({node.name for node in nodes_inside(status)})),
        sessions=sum(1 for session in zenoh.sessions if session.port is not None),
        peers={short(link.peer): _fault(link) for link in islice(peers, MOST_ZENOH_PEERS)},
        sites={short(link.title): _fault(link) for link in islice(sites, MOST_ZENOH_LINKS)},
        hubs={short(link.peer): _fault(link) for link in islice(hubs, MOST_ZENOH_HUBS)},
    )


def _fault(link: ZenohLinkStatus) -> str:
    return "" if link.up else short(link.error) or "not linked"


def _is_reported(problem: ProblemStatus) -> bool:
    """Whether a problem still holds or is recent, and is not a denial by the policy."""
    return problem.subject not in _DENIAL_SUBJECTS and (problem.holds or problem.age <= RECENT_S)


def no_answer(error: str) -> ProxyReport:
    """Return the report on a proxy that does not answer."""
    return ProxyReport(answered=False, error=short(error))


def unreadable(last: ProxyReport, error: str) -> ProxyReport:
    """Return the last report, with ``error`` as the only problem.

    The new answer of the proxy has more bytes than the operator reads.
    """
    return replace(last, problems=(short(error),))


def short(text: str) -> str:
    """Return a text from a proxy, cleaned and cut so that the operator may show the text."""
    # Cut first, with a character more for the ellipsis: to clean a megabyte takes 0.3 s.
    return bounded(clean(text[: _MOST_TEXT_CHARACTERS + 1]), _MOST_TEXT_CHARACTERS)
