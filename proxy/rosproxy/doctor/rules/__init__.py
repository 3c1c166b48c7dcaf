"""The rules of ``rosproxy doctor``: pure functions from gathered facts to findings."""

from rosproxy.doctor.facts import DoctorFacts
from rosproxy.doctor.rules import node, pair, participant, zenoh
from rosproxy.doctor.rules import proxy as proxy_rules
from rosproxy.shared.documents.doctor_finding import DoctorFinding, warning, without_known_names


def diagnose(facts: DoctorFacts) -> list[DoctorFinding]:
    """All findings: about the proxy, the nodes, and the names in the user's question."""
    if facts.proxy.settings.for_ros1:
        first = [*proxy_rules.check(facts), *node.check(facts), *pair.check(facts)]
    else:
        first = [*proxy_rules.alive(facts), *proxy_rules.setup(facts)]
    by_stack = (first, participant.check(facts), [*zenoh.check(facts)])
    # ROS 1 and ROS 2 both report a name that the policy hides.
    return [*dict.fromkeys(without_known_names(by_stack, facts.names))]


def diagnose_running(facts: DoctorFacts) -> list[DoctorFinding]:
    """The findings for the live page, which are made repeatedly: without pairs and domains."""
    if not facts.proxy.settings.for_ros1:
        return []
    return [*proxy_rules.running(facts), *node.check(facts)]


def unknown_variable(name: str, text: str) -> DoctorFinding:
    """The finding about an environment variable of the doctor that no option reads."""
    return warning("variable", name, text, f"unset {name}, and set the variable that was meant")
