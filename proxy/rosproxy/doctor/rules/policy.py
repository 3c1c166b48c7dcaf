"""The finding about a name that the policy hides, for ROS 1 and ROS 2."""

from rosproxy.shared.documents.doctor_finding import DoctorFinding, warning
from rosproxy.shared.documents.status_document import HiddenStatus


def hidden_finding(hidden: HiddenStatus) -> DoctorFinding:
    """The finding that the policy hides a topic or service from outside."""
    text = f"hidden from outside by the policy: {hidden.reason} ({hidden.kind}, {hidden.node})"
    return warning("policy", hidden.name, text, "if outside may use the name, change this rule")
