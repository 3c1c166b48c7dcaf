"""The fixes for errors of Kubernetes: of admission, the scheduler, the kubelet and registries.

The patterns match the texts of Kubernetes 1.36. A fix has no full stop at the end.
"""

import re

from rosproxy_operator.kubernetes.resources.model import RosProxy

NOT_OURS = "the operator did not create"
"""Part of the error about a foreign object that has the name already."""
_ENFORCE_LABEL = "pod-security.kubernetes.io/enforce"
_LIMIT_RANGE = "the LimitRange of the namespace"
# k8s.io/apiserver, pkg/admission/plugin/resourcequota/controller.go; k8s.io/kubernetes,
# pkg/quota/v1/evaluator/core/pods.go, plugin/pkg/admission/limitranger and priority/admission.go;
# k8s.io/apiserver, pkg/admission/plugin/webhook/errors/statuserror.go.
_ADMISSION = (
    (r"exceeded quota.* requested: [^ ]*(cpu|memory|storage)",
     "Raise this ResourceQuota, or lower spec.resources"),
    (r"exceeded quota|insufficient quota", "Raise this ResourceQuota"),
    (r"minimum \S+ usage per", f"Raise spec.resources, or lower the minimum in {_LIMIT_RANGE}"),
    (r"maximum \S+ usage per .* no (request|limit) is specified",
     f"Set this resource in spec.resources, or a default in {_LIMIT_RANGE}"),
    (r"maximum \S+ usage per", f"Lower spec.resources, or raise the maximum in {_LIMIT_RANGE}"),
    (r"max limit to request ratio",
     "Set requests and limits in spec.resources that differ less, or raise the ratio in "
     f"{_LIMIT_RANGE}"),
    (r"no priorityclass with name",
     "Create this PriorityClass, or correct the webhook that names it in pods"),
    (r"admission webhook .* denied the request", "Allow this object in the policy of the webhook"),
    (r"failed calling webhook", "Repair this webhook. The operator tries again"),
    (r"is invalid", "Correct the named field in the RosProxy's spec"),
    (r"user .* cannot",
     "The operator lacks a right. Install the operator's chart or manifests again"),
    (NOT_OURS, "Delete that object, or use another name for the RosProxy"),
)  # fmt: skip
# k8s.io/kubernetes, pkg/scheduler/framework/plugins (tainttoleration, noderesources), and
# pkg/kubelet/lifecycle/predicate.go.
_SCHEDULING = (
    (r"untolerated taint", "Set spec.tolerations as in your pods"),
    (r"too many pods|outofpods", "Remove pods from the node, or raise maxPods of its kubelet"),
    (r"insufficient |outof", "Make room on the node, or lower spec.resources.requests"),
    (r"sysctlforbidden", "Allow the sysctl net.ipv4.ip_local_port_range in the kubelet"),
)
# The errors of registries in the words of containerd; k8s.io/kubernetes, pkg/kubelet/images.
_IMAGE = (
    (r"pull policy of never|errimageneverpull",
     "Load the image on the node, or correct spec.image or spec.imagePullPolicy"),
    (r"unauthorized|authorization failed|access denied|forbidden|no basic auth",
     "Correct the image's name, or set spec.imagePullSecrets"),
    (r"no such host|timeout|deadline exceeded|connection refused|no route|certificate",
     "Let the node reach the registry, or load the image on the node"),
    (r"not found|manifest unknown|invalidimagename|parse image name",
     "Correct the image's name in spec.image or the chart's proxy.image, or load the image on the "
     "node"),
)  # fmt: skip


def admission_fix(message: str, rosproxy: RosProxy) -> str:
    """The fix for an object that the API server refuses."""
    low = message.lower()
    # k8s.io/pod-security-admission, admission/admission.go and policy/.
    if "violates podsecurity" in low or "net_admin" in low or "privilegeescalation" in low:
        return _security_fix(low, rosproxy)
    if "must specify" in low:
        return _unset_fix(low)
    return _first(_ADMISSION, low, "The operator tries again")


def scheduling_fix(message: str) -> str:
    """The fix for a pod that the scheduler or the kubelet refuses."""
    fallback = "Make room on the node, or set spec.tolerations or spec.resources"
    return _first(_SCHEDULING, message.lower(), fallback)


def image_fix(message: str) -> str:
    """The fix for an image that a node can't get."""
    fallback = (
        "Load the image on the node, or set spec.image, spec.imagePullPolicy or "
        "spec.imagePullSecrets"
    )
    return _first(_IMAGE, message.lower(), fallback)


def _first(fixes: tuple[tuple[str, str], ...], low: str, fallback: str) -> str:
    return next((fix for pattern, fix in fixes if re.search(pattern, low)), fallback)


def _unset_fix(low: str) -> str:
    """The fix if a ResourceQuota requires values that the pod lacks.

    A quota for ``cpu`` counts ``requests.cpu``.
    """
    wanted = low.partition("must specify ")[2]
    names = re.findall(r"(?:limits\.|requests\.)?(?:cpu|memory|ephemeral-storage)\b", wanted)
    fields = [name if "." in name else f"requests.{name}" for name in dict.fromkeys(names)]
    where = " and ".join(f"spec.resources.{field}" for field in fields) or "spec.resources"
    return f"Set {where}, or a default in {_LIMIT_RANGE}"


def _security_fix(low: str, rosproxy: RosProxy) -> str:
    if "hostport" not in low and ("net_admin" in low or "privilegeescalation" in low):
        return "Allow NET_ADMIN for proxies in that namespace, or set spec.dataPlane: Auto"
    kernel = rosproxy.spec.proxy.data_plane == "kernel"
    takes = "hostPorts (and NET_ADMIN for spec.dataPlane: Kernel)" if kernel else "hostPorts"
    if rosproxy.spec.multicast:
        takes += ", and the LAN relay of a proxy needs hostNetwork"
    return (
        f"A proxy needs {takes}. This requires Pod Security privileged. Run kubectl label namespace"
        f" {rosproxy.id.namespace} {_ENFORCE_LABEL}=privileged --overwrite"
    )
