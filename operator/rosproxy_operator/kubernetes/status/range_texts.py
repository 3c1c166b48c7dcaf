"""Whether outside reaches a proxy's ports, in words: what its last try proves, and what mends it.

A network plug-in that knows no hostPorts maps none, and nobody says so: pods are ready, the master
is reached, and outside hears nothing. The proxy tries its own range from outside (`range_probe`).
"""

from rosproxy.admin.status_document import RangeProbeStatus
from rosproxy_operator.kubernetes.resources.cluster import RosProxyOnNode
from rosproxy_operator.kubernetes.resources.names import ADVERTISE_HOST

ADDRESS_FIX = f"spec.advertise, or the annotation {ADVERTISE_HOST}=ADDRESS on the node"
_FIREWALL = "let its hostPorts through the node's firewall and any NetworkPolicy"
_PLUGIN = "have the nodes' network plug-in do hostPorts (CNI: the plug-in portmap)"
PORTS_FIX = f"{_PLUGIN}; {_FIREWALL}; or {ADDRESS_FIX}"
"""What mends it, where it is not known how the try ended."""
_NO_ANSWER = ("there is no answer", f"{_FIREWALL}; or set {ADDRESS_FIX}")
_STRANGER = (
    "something else answers there",
    "end what has these ports on the node, or leave them out of spec.portWindow; or set "
    f"{ADDRESS_FIX}",
)
_BY_OUTCOME = {
    "refused": (
        "nothing listens there",
        f"{_PLUGIN}, then delete the proxy's pod; or set {ADDRESS_FIX}",
    ),
    "silent": _NO_ANSWER,
    "unreachable": _NO_ANSWER,
    "closed": _STRANGER,
    "stranger": _STRANGER,
    "unresolvable": ("that name is not known in the cluster", f"set {ADDRESS_FIX}"),
    "ok": (
        "the proxy does, but the master's machine does not",
        f"{_FIREWALL}; or set {ADDRESS_FIX} as the master's machine knows the node",
    ),
}
"""By how the proxy's own try ended: what that means, and what mends it."""


def no_way_in(state: RosProxyOnNode, probe: RangeProbeStatus) -> str:
    """That outside does not reach a node's proxy, with the fix.

    The ports under test are not told: they differ from try to try, and each text is an Event.
    """
    cause, fix = _BY_OUTCOME.get(probe.from_proxy, ("the try failed", PORTS_FIX))
    return f"outside does not reach {_target(state)} ({cause}): {fix}"


def not_proven(state: RosProxyOnNode, probe: RangeProbeStatus | None) -> str:
    """Why it is not known whether outside reaches a node's proxy; to follow the proxy's name."""
    if probe is None:
        return (
            f"it has not tried {_target(state)} yet: that takes a master that answers, and a port "
            "that is free"
        )
    by = " by UDP" if probe.transport == "udp" else ""
    return (
        f"it does not reach {_target(state)}{by} itself, where only the way back may be missing, "
        f"and nobody else could be asked to try. If outside gets nothing: {PORTS_FIX}"
    )


def _target(state: RosProxyOnNode) -> str:
    return f"ports {state.range} of {state.advertise_host}"
