"""The doctor's fixes for conditions of a RosProxy, by the reason of the condition.

A condition has a single text: the message names the object, and ends in the fix of the finding
(`Problem.fix`). So a reason stands here only if the message has no fix, or if a command helps.
"""

from rosproxy_operator.kubernetes.resources.model import Name
from rosproxy_operator.kubernetes.resources.names import ADMIN_PORT, PROXY_OF
from rosproxy_operator.kubernetes.status.range_texts import ADDRESS_FIX, PORTS_FIX

_EDIT = "kubectl -n {of.namespace} edit rosproxy {of.name}"
_PODS = f"read kubectl -n {{of.namespace}} describe pods -l {PROXY_OF}={{of.name}}"
_AS_SAID = (
    f"do as the message says; fields of the spec: {_EDIT}; for more, read kubectl -n "
    "{of.namespace} describe rosproxy {of.name}"
)
_BY_REASON = {
    "LanRelayStuck": _PODS,
    "ImageUnusable": f"correct spec.image ({_EDIT}), or the chart's proxy.image",
    "MasterUnknown": f"correct spec.master: {_EDIT}",
    "MasterUnreachable": "start the master, allow connections, or correct spec.master, as the "
    f"message says: {_EDIT}",
    "HubRefused": f"wait until the operator has recreated all proxies, then {_PODS}",
    "NoAdvertiseHost": f"{ADDRESS_FIX}; fields of the spec: {_EDIT}",
    "NoAddress": "install a controller for Services of type LoadBalancer, or correct spec.listen: "
    f"{_EDIT}",
    "NodeLeftOut": f"correct spec.nodeSelector: {_EDIT}",
    "PeerUnreachable": f"do as the message says, or correct spec.peers: {_EDIT}",
    "PolicyRefused": f"change spec.image, or remove spec.image: {_EDIT}",
    "PortConflict": f"set a spec.portWindow without the ports that other programs use: {_EDIT}",
    "PortsExhausted": f"lower spec.ports, or widen spec.portWindow: {_EDIT}",
    "PortsUnreachable": PORTS_FIX,
    "ProxiesStarting": f"wait a moment, then {_PODS}",
    "ProxyStuck": f"do as the message says; fields of the spec: {_EDIT}; for more, {_PODS}",
    "ProxyUnreachable": "allow connections from the operator's pods to port "
    f"{ADMIN_PORT} of pods with the label {PROXY_OF}={{of.name}}; read kubectl -n {{of.namespace}} "
    "get networkpolicies",
    "SiteUnreachable": f"do as the message says, or correct spec.link: {_EDIT}",
    "LinkCertificate": "put a new certificate into the Secret of spec.link.secretName, as the "
    "message says",
    "ProxyWarns": f"read the findings of the proxies' doctors below; fields of the spec: {_EDIT}",
}


def fix_for(reason: str, of: Name) -> str:
    """The fix for a condition with this reason; for other reasons, the way to the message's fix."""
    return _BY_REASON.get(reason, _AS_SAID).format(of=of)
