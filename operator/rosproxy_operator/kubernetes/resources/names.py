"""What the operator calls things in a cluster: names, labels, annotations, ports."""

import hashlib
import hmac
import re
from collections.abc import Mapping
from functools import lru_cache

from rosproxy_operator.common.ros2 import relay_secret
from rosproxy_operator.kubernetes.resources.model import Name

GROUP = "rosproxy.io"
VERSION = "v1alpha1"
API_VERSION = f"{GROUP}/{VERSION}"
KIND = "RosProxy"
PLURAL = "rosproxies"

INJECT = "rosproxy.io/inject"
"""Label of users' pods: "true" or a RosProxy's name."""
PROXY_OF = "rosproxy.io/proxy-of"
"""Label of proxies' pods and of Services: the name of their RosProxy."""
NODE = "rosproxy.io/node"
PORT_RANGE = "rosproxy.io/port-range"
FINGERPRINT = "rosproxy.io/fingerprint"
ADVERTISE_HOST = "rosproxy.io/advertise-host"
"""Annotation of nodes, which users set, and of proxies' pods."""
MASTER_URI = "rosproxy.io/master-uri"
"""Annotation of users' pods: the ROS_MASTER_URI that the webhook has set."""
REPLACED_URI = "rosproxy.io/replaced-master-uri"
"""Annotation of users' pods: the ROS_MASTER_URI of their template that the webhook has replaced."""
ALLOW_FROM = "rosproxy.io/allow-from"
"""Annotation of masters' Services: namespaces whose RosProxies may name them."""

STATIC_PEERS = "rosproxy.io/static-peers"
"""Annotation of users' pods: the ROS_STATIC_PEERS that the webhook has set."""

REMAKE = "rosproxy.io/remake-unwired"
"""Annotation of RosProxies: "true" has pods made anew that came by unwired."""

NAME_LABEL = "app.kubernetes.io/name"
COMPONENT_LABEL = "app.kubernetes.io/component"
MANAGED_BY_LABEL = "app.kubernetes.io/managed-by"
PROXY = "proxy"
LAN_RELAY = "lan-relay"
IMAGE_CHECK = "image-check"
"""What is made for a RosProxy, by the component label."""
_FORMER_LAN_RELAY = "ear"
"""The component of LAN relays that operators before 0.1.0 made; they are made anew."""
_OWN = {NAME_LABEL: "rosproxy", MANAGED_BY_LABEL: "rosproxy-operator"}
_COMPONENTS = (_FORMER_LAN_RELAY, IMAGE_CHECK, LAN_RELAY, PROXY)
_EITHER = f"{COMPONENT_LABEL} in ({','.join(_COMPONENTS)})"
OWN_SELECTOR = ",".join([*(f"{label}={value}" for label, value in _OWN.items()), _EITHER])
"""Label selector, in the API's words, of everything that the operator makes."""

MASTER_PORT = 11311
ADMIN_PORT = 11312
CONTAINER = "proxy"
"""Name of the container in a proxy's pod."""
TOKEN_VARIABLE = "ROSPROXY_ADMIN_TOKEN"  # noqa: S105 - the variable's name
"""Where former operators wrote the token itself."""

_PREFIX = "rosproxy-"
_DIGITS = 6
_LONGEST = 63
"""A pod whose name is longer is cut off in its host name."""
_SLUG = 30


def own_labels(rosproxy: str, component: str = PROXY) -> dict[str, str]:
    """The labels of a proxy's pod and of the Service of the given RosProxy."""
    return {**_OWN, COMPONENT_LABEL: component, PROXY_OF: rosproxy}


def is_own(labels: Mapping[str, str]) -> bool:
    """Whether labels are those that the operator gives to what it makes."""
    same = all(labels.get(label) == value for label, value in _OWN.items())
    return same and labels.get(COMPONENT_LABEL) in _COMPONENTS and PROXY_OF in labels


def component(labels: Mapping[str, str]) -> str:
    """What an object is: PROXY, LAN_RELAY or IMAGE_CHECK; empty if it is not the operator's."""
    if not is_own(labels):
        return ""
    component = labels[COMPONENT_LABEL]
    return LAN_RELAY if component == _FORMER_LAN_RELAY else component


def service_id(rosproxy: Name) -> Name:
    """The namespace and name of a RosProxy's Service."""
    return Name(rosproxy.namespace, f"{_PREFIX}{rosproxy.name}")


@lru_cache(maxsize=8192)
def proxy_id(rosproxy: Name, node: str) -> Name:
    """The name of a RosProxy's pod on a node, always the same, so that there are never two."""
    digest = hashlib.sha256(f"{rosproxy.name} {node}".encode()).hexdigest()[:_DIGITS]
    room = min(_SLUG, _LONGEST - len(f"{_PREFIX}{rosproxy.name}--{digest}"))
    slug = re.sub(r"[^a-z0-9]+", "-", node.lower())[: max(room, 0)].strip("-")
    segments = (f"{_PREFIX}{rosproxy.name}", slug, digest)
    return Name(rosproxy.namespace, "-".join(s for s in segments if s))


def lan_relay_id(rosproxy: Name, node: str) -> Name:
    """The name of the pod in which the LAN relay of a RosProxy's proxy on a node runs."""
    proxy = proxy_id(rosproxy, node)
    return Name(proxy.namespace, f"{proxy.name}-lan-relay")


def image_check_id(rosproxy: Name, node: str) -> Name:
    """The name of the pod that tries the image of a RosProxy's proxy on a node."""
    proxy = proxy_id(rosproxy, node)
    return Name(proxy.namespace, f"{proxy.name}-{IMAGE_CHECK}")


def policy_id(rosproxy: Name) -> Name:
    """The namespace and name of the NetworkPolicy of a RosProxy's proxies."""
    return Name(rosproxy.namespace, f"{_PREFIX}{rosproxy.name}")


def pods_policy_id(rosproxy: Name) -> Name:
    """The namespace and name of the NetworkPolicy of a RosProxy's pods.

    No RosProxy's name has a dot: it is never that of another one's proxies.
    """
    return Name(rosproxy.namespace, f"{_PREFIX}{rosproxy.name}.pods")


def token_of(key: bytes, proxy: Name, node: str) -> str:
    """The token of a proxy's admin endpoint, which only who has the operator's key can tell.

    It stands nowhere: the pod has its hash alone. Empty if there is no key.
    """
    message = f"{proxy} {node}".encode()
    return hmac.new(key, message, hashlib.sha256).hexdigest() if key else ""


def relay_secret_of(key: bytes, proxy: Name, node: str) -> str:
    """What a proxy and its LAN relay prove to each other that they know. Empty without a key."""
    return relay_secret(key, f"{proxy} {node}") if key else ""


def master_uri(cluster_ip: str) -> str:
    """What pods use as their ROS_MASTER_URI, from the cluster IP of the RosProxy's Service."""
    host = f"[{cluster_ip}]" if ":" in cluster_ip else cluster_ip
    return f"http://{host}:{MASTER_PORT}"
