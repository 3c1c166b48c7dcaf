"""The rules of ``rosproxy doctor``: pure functions from gathered facts to findings."""

from rosproxy.doctor.facts import DoctorFacts
from rosproxy.doctor.findings import DoctorFinding
from rosproxy.doctor.rules import node, pair
from rosproxy.doctor.rules import proxy as proxy_rules


def diagnose(facts: DoctorFacts) -> list[DoctorFinding]:
    """Everything that can be said: about the proxy, the nodes, and the names asked for."""
    return [*proxy_rules.check(facts), *node.check(facts), *pair.check(facts)]
