"""What to do about a condition of a RosProxy, by its reason, as commands and fields: the doctor's.

The message of the condition names the object and says the same in full.
"""

from rosproxy_operator.kubernetes.resources.model import Name
from rosproxy_operator.kubernetes.resources.names import ADMIN_PORT, INJECT, PROXY_OF
from rosproxy_operator.kubernetes.status.range_texts import ADDRESS_FIX, PORTS_FIX

_EDIT = "kubectl -n {of.namespace} edit rosproxy {of.name}"
_DESCRIBE = "kubectl -n {of.namespace} describe rosproxy {of.name}"
_PODS = f"kubectl -n {{of.namespace}} describe pods -l {PROXY_OF}={{of.name}}"
_RESTART = "kubectl -n {of.namespace} rollout restart deployment/NAME"
_TEMPLATE = f"correct the pod's template as the message says, then {_RESTART}"
_BY_REASON = {
    "Ambiguous": f"label the pod's template with the name of one: {INJECT}={{of.name}}",
    "LanRelayStuck": _PODS,
    "ImageUnusable": f"{_EDIT}: spec.image; or the chart's proxy.image",
    "HostNetwork": f"take hostNetwork, or the label {INJECT}, out of the pod's template",
    "Invalid": f"{_EDIT}: the field that the message names",
    "MasterUnknown": f"{_EDIT}: spec.master",
    "MasterUnreachable": f"start the master; or {_EDIT}: spec.master, with spec.master.address "
    "where the cluster does not know its name",
    "NameTaken": "delete or rename the object that the message names",
    "NoAdvertiseHost": ADDRESS_FIX,
    "NodeLeftOut": f"{_EDIT}: spec.nodeSelector",
    "NodeNotReady": "kubectl get nodes; kubectl describe node NODE",
    "NotAllowed": f"{_EDIT}: the field that the message names; or allow it, by the chart's allow…",
    "NotWired": _TEMPLATE,
    "OtherDomain": _TEMPLATE,
    "PolicyRefused": f"{_EDIT}: another spec.image, or none",
    "PortConflict": f"{_EDIT}: leave the ports that others take out of spec.portWindow",
    "PortsExhausted": f"{_EDIT}: fewer spec.ports, or a wider spec.portWindow",
    "PortsUnreachable": PORTS_FIX,
    "ProxiesStarting": f"wait a moment; {_PODS}",
    "ProxyStuck": _PODS,
    "ProxyUnreachable": f"let the operator's pods connect to port {ADMIN_PORT} of pods with the "
    f"label {PROXY_OF}={{of.name}} (kubectl -n {{of.namespace}} get networkpolicies)",
    "ProxyWarns": "what the proxies' own doctors say, below",
    "UnknownName": "correct the name where the message says; of pods in their template, then "
    f"{_RESTART}",
}


def fix_for(reason: str, of: Name) -> str:
    """What mends a condition with this reason; where that is not known, where to look."""
    return _BY_REASON.get(reason, _DESCRIBE).format(of=of)
