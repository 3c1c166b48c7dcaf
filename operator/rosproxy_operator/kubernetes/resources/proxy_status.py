"""What a proxy's ``/status`` means for a RosProxy's. Texts and lists may be of any size there."""

from rosproxy.admin.status_document import ProxyStatus
from rosproxy.telemetry.text import clean
from rosproxy_operator.common.problem import bounded
from rosproxy_operator.common.proxy_status import nodes_by_address
from rosproxy_operator.kubernetes.resources.model import ProxyReport

LONGEST = 300
"""Characters of a problem or an error."""
RECENT = 300.0
"""Seconds that a problem counts: a proxy tells the last ones, however old they are."""


def report(status: ProxyStatus) -> ProxyReport:
    """What a proxy says. Nodes that it has given up already are not among its nodes."""
    master = status.master
    nodes = nodes_by_address(status)
    every = [node for there in nodes.values() for node in there]
    return ProxyReport(
        answered=True,
        master_up=master.up,
        error="" if master.up else _short(master.error or "not asked yet"),
        nodes={
            address: tuple(sorted({name for node in there for name in node.nodes}))
            for address, there in nodes.items()
        },
        topics=frozenset(topic for node in every for topic in node.publishes + node.subscribes),
        used=status.ports.used,
        problems=tuple(
            _short(f"{one.subject}: {one.text}") for one in status.problems if one.age <= RECENT
        ),
    )


def no_answer(error: str) -> ProxyReport:
    """What is known of a proxy that does not answer."""
    return ProxyReport(answered=False, error=_short(error))


def _short(text: str) -> str:
    return bounded(clean(text), LONGEST)
