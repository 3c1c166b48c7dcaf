"""The doctor's fixes for conditions of a RosProxy, by the reason of the condition.

The message of the condition names the object, and has the same fix in full.
"""

from rosproxy_operator.kubernetes.resources.model import Name
from rosproxy_operator.kubernetes.resources.names import ADMIN_PORT, INJECT, PROXY_OF
from rosproxy_operator.kubernetes.status.range_texts import ADDRESS_FIX, PORTS_FIX

_EDIT = "kubectl -n {of.namespace} edit rosproxy {of.name}"
_DESCRIBE = "read kubectl -n {of.namespace} describe rosproxy {of.name}"
_PODS = f"read kubectl -n {{of.namespace}} describe pods -l {PROXY_OF}={{of.name}}"
_BY_POD = "follow the message, which gives the command for each pod"
_BY_REASON = {
    "Ambiguous": "set the label in the pod's template to the name of one RosProxy, such as "
    f"{INJECT}={{of.name}}",
    "LanRelayStuck": _PODS,
    "ImageUnusable": f"correct spec.image ({_EDIT}), or the chart's proxy.image",
    "HostNetwork": f"remove hostNetwork, or the label {INJECT}, from the pod's template",
    "Invalid": f"correct the field that the message names: {_EDIT}",
    "MasterUnknown": f"correct spec.master: {_EDIT}",
    "MasterUnreachable": "start the master, allow connections, or correct spec.master, as the "
    f"message says: {_EDIT}",
    "NameTaken": "delete the object that the message names, or create it under another name",
    "HubsApart": "let the proxies connect to each other's port 7447, and check that pods resolve "
    "names by the cluster's DNS",
    "HubRefused": f"wait until the operator has recreated all proxies, then {_PODS}",
    "NoAdvertiseHost": ADDRESS_FIX,
    "NoAddress": "install a controller for Services of type LoadBalancer, or correct spec.listen: "
    f"{_EDIT}",
    "NoZenoh": _BY_POD,
    "NodeLeftOut": f"correct spec.nodeSelector: {_EDIT}",
    "NodeNotReady": "read kubectl get nodes, and kubectl describe node NODE",
    "NotAllowed": f"change the field that the message names ({_EDIT}), or have the value allowed "
    "as the message says",
    "NotWired": _BY_POD,
    "OtherDomain": _BY_POD,
    "PeerUnreachable": f"do as the message says, or correct spec.peers: {_EDIT}",
    "PolicyRefused": f"change spec.image, or remove spec.image: {_EDIT}",
    "PortConflict": f"set a spec.portWindow without the ports that other programs use: {_EDIT}",
    "PortsExhausted": f"lower spec.ports, or widen spec.portWindow: {_EDIT}",
    "PortsUnreachable": PORTS_FIX,
    "ProxiesStarting": f"wait a moment, then {_PODS}",
    "ProxyNotAdmitted": f"do as the message says; fields of the spec: {_EDIT}",
    "ProxyStuck": f"do as the message says; fields of the spec: {_EDIT}; for more, {_PODS}",
    "ProxyUnreachable": "allow connections from the operator's pods to port "
    f"{ADMIN_PORT} of pods with the label {PROXY_OF}={{of.name}}; read kubectl -n {{of.namespace}} "
    "get networkpolicies",
    "SiteUnreachable": f"do as the message says, or correct spec.link: {_EDIT}",
    "LinkCertificate": "put a new certificate into the Secret of spec.link.secretName, as the "
    "message says",
    "ProxyWarns": f"read the findings of the proxies' doctors below; fields of the spec: {_EDIT}",
    "UnknownName": "correct the name where the message says; for a pod, run the command in the "
    "message",
}


def fix_for(reason: str, of: Name) -> str:
    """The fix for a condition with this reason; for other reasons, the command to read more."""
    return _BY_REASON.get(reason, _DESCRIBE).format(of=of)
