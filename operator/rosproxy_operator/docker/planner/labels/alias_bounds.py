"""Decide which names a label may give a proxy on a network.

A proxy answers to the host name of its master, so that ``ROS_MASTER_URI`` needs no change. An image
can carry any name: all containers of the network would then reach the proxy in place of the service
of that name. No list of names or ports tells a robot from a database. So there are two rules:

1. The administrator lists the name. Without a list, the name has the form of a LAN's names.
2. No container has the name. If the administrator does not list the name, no container had the name
   before, either (`planner.taken_names`).

The address of a name is no criterion. Services of a company have private addresses, like robots.
The owner of a public name can give the name a private address. A robot can have a public address.
Besides, the answer of a name server changes, and each change would cut connections.
"""

import re
from fnmatch import fnmatchcase

from rosproxy.shared.uris import parse_slave_uri
from rosproxy_operator.docker.planner.labels.readers import MOST_HOST_CHARACTERS
from rosproxy_operator.docker.settings import PlanSettings

LAN_SUFFIXES = ("local", "lan", "home", "localdomain", "home.arpa", "test")
"""Ends of names that belong to a single LAN.

``local``: RFC 6762, 3. ``lan`` and ``home``: RFC 6762, appendix G. ``home.arpa``: RFC 8375, 3.
``test``: RFC 6761, 6.2. ``localdomain``: the end that Debian's and Red Hat's hosts files have.
"""
# Other private suffixes are left out, since services have such names. Companies use corp, intranet
# and private (RFC 6762, appendix G). ICANN has reserved internal for private use (Board resolution
# 2024.07.29.06), but there are metadata.google.internal, host.docker.internal,
# gateway.docker.internal and host.containers.internal.
_CLUSTER_SUFFIX = "cluster.local"
"""The default suffix of names in a Kubernetes cluster (kubelet: --cluster-domain)."""
_OWN_PREFIX = "rosproxy"
"""The beginning of the names of all containers of the operator."""
_HOST_NAME = re.compile(r"(?!-)[a-z0-9_-]{1,63}(?<!-)(\.(?!-)[a-z0-9_-]{1,63}(?<!-))*")


def is_allowed_by_administrator(name: str, settings: PlanSettings) -> bool:
    """Return whether --master-uri or --allow-alias names a host. ``name`` is in lower case."""
    master = parse_slave_uri(settings.master_uri or "")
    is_own_master = master is not None and name == master.host.lower()
    return is_own_master or any(fnmatchcase(name, p) for p in settings.allow_alias)


def alias_refusal(name: str, settings: PlanSettings) -> str:
    """Return why labels may not give a proxy a name in lower case; empty for an allowed name."""
    if not _HOST_NAME.fullmatch(name) or len(name) > MOST_HOST_CHARACTERS:
        return "the name is not a host name"
    if is_allowed_by_administrator(name, settings):
        return ""
    if settings.allow_alias:
        return (
            f"the name matches no --allow-alias of the operator ({', '.join(settings.allow_alias)})"
        )
    return _lan_refusal(name)


def _lan_refusal(name: str) -> str:
    """Return why a name is no name of a host in a LAN; empty if the name has that form."""
    if name.startswith(_OWN_PREFIX):
        return f"names that begin with {_OWN_PREFIX} are reserved for the operator"
    if _ends_in(name, _CLUSTER_SUFFIX):
        return f"names in .{_CLUSTER_SUFFIX} belong to services of a Kubernetes cluster"
    if "." in name and not any(_ends_in(name, suffix) for suffix in LAN_SUFFIXES):
        return f"the name has a dot, and is not in .{', .'.join(LAN_SUFFIXES)}"
    return ""


def _ends_in(name: str, suffix: str) -> bool:
    return name == suffix or name.endswith(f".{suffix}")
