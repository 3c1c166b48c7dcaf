"""Texts about whether outside reaches a proxy's ports: the result of the last test, and the fix.

A network plug-in without support for hostPorts maps no port and reports no error. Then the pods are
ready, the proxies reach the master, and outside receives nothing. So the proxy tests its own range
from outside (`range_probe`).
"""

from rosproxy.shared.documents.status_document import RangeProbeStatus
from rosproxy.shared.fixes import FIXES
from rosproxy_operator.common.problem import Fault
from rosproxy_operator.kubernetes.resources.cluster import RosProxyOnNode

ADDRESS_FIX = FIXES["advertised host"].kubernetes
_FIREWALL = "open the proxy's hostPorts in the node's firewall and in NetworkPolicies"
_PLUGIN = "enable hostPorts in the nodes' network plug-in (CNI: the plug-in portmap)"
PORTS_FIX = f"{FIXES['publish'].kubernetes}; or {ADDRESS_FIX}"
"""The fix if the outcome of the test is unknown."""
_NO_ANSWER = ("there is no answer", f"{_FIREWALL}; or {ADDRESS_FIX}")
_STRANGER = (
    "another program answers there",
    "stop the program that has these ports on the node, or set a spec.portWindow without these "
    f"ports; or {ADDRESS_FIX}",
)
_BY_OUTCOME = {
    "refused": (
        "nothing listens there",
        f"{_PLUGIN}, then delete the proxy's pod; or {ADDRESS_FIX}",
    ),
    "silent": _NO_ANSWER,
    "unreachable": _NO_ANSWER,
    "closed": _STRANGER,
    "stranger": _STRANGER,
    "unresolvable": ("the cluster can't resolve that name", ADDRESS_FIX),
    "ok": (
        "the proxy reaches these ports, but the master's machine does not",
        f"{_FIREWALL}; or {ADDRESS_FIX}. Use the address of the node as the master's machine sees "
        "it",
    ),
}
"""The cause and the fix, by the outcome of the proxy's own test."""


def no_way_in(state: RosProxyOnNode, probe: RangeProbeStatus) -> Fault:
    """The fault that outside does not reach the proxy of a node.

    The text leaves out the tested ports: each test takes other ports, and each text is an Event.
    """
    cause, fix = _BY_OUTCOME.get(probe.from_proxy, ("the test failed", PORTS_FIX))
    text = f"outside does not reach {_target(state)} ({cause})"
    return Fault(text, f"{fix[:1].upper()}{fix[1:]}")


def not_proven(state: RosProxyOnNode, probe: RangeProbeStatus | None) -> str:
    """Why it is unknown whether outside reaches the ports, with the next step.

    The name of the proxy precedes this text.
    """
    if probe is None:
        return (
            f"has not tested {_target(state)} yet. The test needs a master that answers and a free "
            "port"
        )
    by = " by UDP" if probe.transport == "udp" else ""
    return (
        f"does not reach {_target(state)}{by} itself. Perhaps only the proxy can't reach its own "
        "ports, as with some NAT, and no other host could be asked to test. If outside gets "
        f"nothing: {PORTS_FIX}"
    )


def _target(state: RosProxyOnNode) -> str:
    return f"ports {state.range} of {state.advertise_host}"
