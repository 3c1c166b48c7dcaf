"""The rules of ``rosproxy doctor``: pure functions from gathered facts to findings."""

from rosproxy.core.doctor import node_rules, pair_rules, proxy_rules
from rosproxy.core.doctor.facts import Facts
from rosproxy.core.doctor.findings import Finding


def diagnose(facts: Facts) -> list[Finding]:
    """Everything that can be said: about the proxy, the nodes, and the names asked for."""
    return [*proxy_rules.check(facts), *node_rules.check(facts), *pair_rules.check(facts)]
