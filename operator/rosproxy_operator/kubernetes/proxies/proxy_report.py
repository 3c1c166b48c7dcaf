"""What of a proxy's status matters to the operator."""

from rosproxy.admin.status_document import ProxyStatus
from rosproxy.telemetry.text import clean
from rosproxy_operator.common.problem import bounded
from rosproxy_operator.common.proxy_status import (
    leases,
    nodes_by_address,
    participants_by_address,
)
from rosproxy_operator.kubernetes.resources.cluster import ProxyReport

RECENT = 300.0
"""Seconds that a problem counts: a proxy tells the last ones, however old they are."""
_LONGEST = 300
"""Characters of a problem or an error, which may be of any size there."""


def report(status: ProxyStatus, refusal: str = "") -> ProxyReport:
    """What a proxy says, and why it does not take its policy.

    Nodes that it has given up already are not among its nodes.
    """
    master, nodes = status.master, nodes_by_address(status)
    every = [node for there in nodes.values() for node in there]
    topics = {topic for node in every for topic in node.publishes + node.subscribes}
    participants = participants_by_address(status)
    for one in (one for there in participants.values() for one in there):
        topics.update(one.publishes + one.subscribes)
    up = master.up or "1" not in status.settings.ros
    return ProxyReport(
        answered=True,
        master_up=up,
        error="" if up else short(master.error or "not asked yet"),
        participants={
            address: tuple(one.guid_prefix for one in there)
            for address, there in participants.items()
        },
        leases=leases(status),
        nodes={
            address: tuple(sorted({name for node in there for name in node.nodes}))
            for address, there in nodes.items()
        },
        topics=frozenset(topics),
        refusal=refusal,
        problems=tuple(
            short(f"{one.subject}: {one.text}") for one in status.problems if one.age <= RECENT
        ),
    )


def no_answer(error: str) -> ProxyReport:
    """What is known of a proxy that does not answer."""
    return ProxyReport(answered=False, error=short(error))


def short(text: str) -> str:
    """What a proxy says, as it may be shown."""
    return bounded(clean(text), _LONGEST)
