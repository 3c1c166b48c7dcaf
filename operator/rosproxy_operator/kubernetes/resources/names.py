"""Names, labels, annotations and ports of the operator's objects in a cluster."""

import hashlib
import hmac
import re
from collections.abc import Mapping
from functools import lru_cache

from rosproxy.shared.addresses import HostPort, parse_host_port
from rosproxy.shared.ports import PortRange
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
"""Label of all objects that the operator creates: the name of the RosProxy."""
NODE = "rosproxy.io/node"
"""Annotation of the operator's pods: the node that the operator has chosen."""
PORT_RANGE = "rosproxy.io/port-range"
"""Annotation of proxies' pods: the range."""
FINGERPRINT = "rosproxy.io/fingerprint"
"""Annotation of the operator's pods and Services."""
ADVERTISE_HOST = "rosproxy.io/advertise-host"
"""Annotation of nodes, set by users, and of proxies' pods, set by the operator."""
MASTER_URI = "rosproxy.io/master-uri"
"""Annotation of users' pods: the ROS_MASTER_URI that the webhook has set."""
REPLACED_URI = "rosproxy.io/replaced-master-uri"
"""Annotation of users' pods: the ROS_MASTER_URI of the template, which the webhook has replaced."""
ALLOW_FROM = "rosproxy.io/allow-from"
"""Annotation of masters' Services: other namespaces whose RosProxies may name the Service."""

STATIC_PEERS = "rosproxy.io/static-peers"
"""Annotation of users' pods: the ROS_STATIC_PEERS that the webhook has set."""

DOMAIN = "rosproxy.io/wired-domain"
"""Annotation of users' pods: the ROS_DOMAIN_ID that the webhook has set."""

NOT_WIRED_BECAUSE = "rosproxy.io/not-wired-because"
"""Annotation of users' pods: why the webhook has set no variable."""

ROUTER_ENDPOINT = "rosproxy.io/router-endpoint"
"""Annotation of users' pods: the endpoint of the router in the ZENOH_CONFIG_OVERRIDE that the
webhook has set."""

REMAKE = "rosproxy.io/remake-unwired"
"""Annotation of RosProxies. With "true" the operator evicts unwired pods."""

NAME_LABEL = "app.kubernetes.io/name"
COMPONENT_LABEL = "app.kubernetes.io/component"
MANAGED_BY_LABEL = "app.kubernetes.io/managed-by"
PROXY = "proxy"
"""Component label of the objects for proxies, also of Services and NetworkPolicies."""
LAN_RELAY = "lan-relay"
IMAGE_CHECK = "image-check"
_FORMER_LAN_RELAY = "ear"
"""Component of LAN relays from operators before 0.1.0. The operator recreates such a relay."""
_OWN_LABELS = {NAME_LABEL: "rosproxy", MANAGED_BY_LABEL: "rosproxy-operator"}
_COMPONENTS = (_FORMER_LAN_RELAY, IMAGE_CHECK, LAN_RELAY, PROXY)
_COMPONENT_SELECTOR = f"{COMPONENT_LABEL} in ({','.join(_COMPONENTS)})"
OWN_SELECTOR = ",".join(
    [*(f"{label}={value}" for label, value in _OWN_LABELS.items()), _COMPONENT_SELECTOR]
)
"""Label selector of all objects that the operator creates."""

MASTER_PORT = 11311
ADMIN_PORT = 11312
HUB_PORT = 7447
"""At this port of a proxy for rmw_zenoh, the proxies of other nodes reach the hub."""
ROUTERS = PortRange(7448, 7448)
"""The port of a proxy for rmw_zenoh at which pods reach a router. This is the range of such a
proxy, and no hostPort."""
OUTSIDE_PORT = 7449
"""The port of a proxy for rmw_zenoh for laptops, and for routers of other sites."""
OUTSIDE_SERVICE_PORT = 7447
"""The port of the Service that leads to OUTSIDE_PORT: the port of rmw_zenohd."""
CONTAINER = "proxy"
"""Name of the container in a proxy's pod."""
TOKEN_VARIABLE = "ROSPROXY_ADMIN_TOKEN"  # noqa: S105 - the variable's name
"""Variable in which former operators wrote the token itself."""

_PREFIX = "rosproxy-"
_HUBS_PREFIX = "hubs-of-rosproxy-"
_OUTSIDE_PREFIX = "port-of-rosproxy-"
_HASH_DIGITS = 6
"""Hex digits of the hash in a pod's name."""
_MOST_HOST_NAME_CHARACTERS = 63
"""Characters of a pod's host name. Kubernetes cuts off a longer pod name there."""
_MOST_NODE_NAME_CHARACTERS = 30
"""Characters of the node's name in a pod's name."""


def own_labels(rosproxy: str, component: str = PROXY) -> dict[str, str]:
    """Return the labels of an object that the operator creates for a RosProxy."""
    return {**_OWN_LABELS, COMPONENT_LABEL: component, PROXY_OF: rosproxy}


def is_own(labels: Mapping[str, str]) -> bool:
    """Whether labels are the labels of an object that the operator has created."""
    same = all(labels.get(label) == value for label, value in _OWN_LABELS.items())
    return same and labels.get(COMPONENT_LABEL) in _COMPONENTS and PROXY_OF in labels


def component(labels: Mapping[str, str]) -> str:
    """Return PROXY, LAN_RELAY or IMAGE_CHECK; empty for an object that is not the operator's."""
    if not is_own(labels):
        return ""
    component = labels[COMPONENT_LABEL]
    return LAN_RELAY if component == _FORMER_LAN_RELAY else component


def service_id(rosproxy: Name) -> Name:
    """Return the namespace and name of a RosProxy's Service."""
    return Name(rosproxy.namespace, f"{_PREFIX}{rosproxy.name}")


@lru_cache(maxsize=8192)
def proxy_id(rosproxy: Name, node: str) -> Name:
    """Return the namespace and name of the pod for a RosProxy's proxy on a node.

    The name is always the same. So the API server refuses a second pod for the same place.
    """
    digest = hashlib.sha256(f"{rosproxy.name} {node}".encode()).hexdigest()[:_HASH_DIGITS]
    room = min(
        _MOST_NODE_NAME_CHARACTERS,
        _MOST_HOST_NAME_CHARACTERS - len(f"{_PREFIX}{rosproxy.name}--{digest}"),
    )
    slug = re.sub(r"[^a-z0-9]+", "-", node.lower())[: max(room, 0)].strip("-")
    segments = (f"{_PREFIX}{rosproxy.name}", slug, digest)
    return Name(rosproxy.namespace, "-".join(s for s in segments if s))


def lan_relay_id(rosproxy: Name, node: str) -> Name:
    """Return the namespace and name of the LAN relay for a RosProxy's proxy on a node."""
    proxy = proxy_id(rosproxy, node)
    return Name(proxy.namespace, f"{proxy.name}-lan-relay")


def image_check_id(rosproxy: Name, node: str) -> Name:
    """Return the namespace and name of the image check for a RosProxy's proxy on a node."""
    proxy = proxy_id(rosproxy, node)
    return Name(proxy.namespace, f"{proxy.name}-{IMAGE_CHECK}")


def hubs_service_id(rosproxy: Name) -> Name:
    """Return the namespace and name of the headless Service that names the hubs of a RosProxy.

    A name of `service_id` begins with ``rosproxy-``, so this name differs from all of them.
    """
    return Name(rosproxy.namespace, f"{_HUBS_PREFIX}{rosproxy.name}")


def outside_service_id(rosproxy: Name) -> Name:
    """Return the namespace and name of the Service at which outside reaches the proxies."""
    return Name(rosproxy.namespace, f"{_OUTSIDE_PREFIX}{rosproxy.name}")


def hub_domain(rosproxy: Name) -> str:
    """Return the part that the DNS names of a RosProxy's hubs share."""
    hubs = hubs_service_id(rosproxy)
    return f"{hubs.name}.{hubs.namespace}.svc"


def hub_address(rosproxy: Name, node: str) -> HostPort:
    """Return the name and port at which the hubs of other nodes reach the hub on a node.

    The name stays the same when the proxy's pod is recreated with another address.
    """
    return HostPort(f"{proxy_id(rosproxy, node).name}.{hub_domain(rosproxy)}", HUB_PORT)


def policy_id(rosproxy: Name) -> Name:
    """Return the namespace and name of the NetworkPolicy for a RosProxy's proxies."""
    return Name(rosproxy.namespace, f"{_PREFIX}{rosproxy.name}")


def pods_policy_id(rosproxy: Name) -> Name:
    """Return the namespace and name of the NetworkPolicy for a RosProxy's selected pods.

    The name of a RosProxy has no dot. So this name differs from each name of `policy_id`.
    """
    return Name(rosproxy.namespace, f"{_PREFIX}{rosproxy.name}.pods")


def token_of(key: bytes, proxy: Name, node: str) -> str:
    """Return the token of a proxy's admin endpoint: HMAC-SHA256 in hex, empty without a key.

    Only a program with the operator's key can compute the token. The pod has only the hash of the
    token.
    """
    message = f"{proxy} {node}".encode()
    return hmac.new(key, message, hashlib.sha256).hexdigest() if key else ""


def relay_secret_of(key: bytes, proxy: Name, node: str) -> str:
    """Return the secret of a proxy and its LAN relay, empty without a key."""
    return relay_secret(key, f"{proxy} {node}") if key else ""


def router_of(cluster_ip: str) -> HostPort:
    """Return the router for pods at the cluster IP of the RosProxy's Service."""
    return HostPort(cluster_ip, ROUTERS.first)


def router_host(endpoint: str) -> str:
    """Return the host of an endpoint such as ``tcp/10.96.0.7:7448``; empty if it has none."""
    router = parse_host_port(endpoint.removeprefix("tcp/"))
    return router.host if router else ""


def master_uri(cluster_ip: str) -> str:
    """Return the ROS_MASTER_URI for pods, from the cluster IP of the RosProxy's Service."""
    host = f"[{cluster_ip}]" if ":" in cluster_ip else cluster_ip
    return f"http://{host}:{MASTER_PORT}"
