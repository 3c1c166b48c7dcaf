"""What each proxy is told of its policy: the administrator's layer, and that of its RosProxy.

A RosProxy that asks for more than it may keeps its proxies, so its policy counts as well. A proxy
whose RosProxy is gone or can't be read is left out: it goes on with what it knows.
"""

from collections.abc import Mapping

from rosproxy.access.layers import PolicyLayer
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot
from rosproxy_operator.kubernetes.resources.model import RosProxy
from rosproxy_operator.kubernetes.settings import ClusterSettings


def policy_of(rosproxy: RosProxy, settings: ClusterSettings) -> tuple[PolicyLayer, ...]:
    """The layers of a RosProxy's proxies; each further layer can only narrow."""
    return (*settings.policy, *rosproxy.spec.policy)


def policies(
    observed: ClusterSnapshot, settings: ClusterSettings
) -> Mapping[str, tuple[PolicyLayer, ...]]:
    """The policy of each proxy, by the uid of its pod."""
    rosproxies = {r.uid: r for r in observed.rosproxies if not r.deleting}
    return {
        proxy.pod.uid: policy_of(rosproxies[proxy.owner], settings)
        for proxy in observed.proxies
        if proxy.owner in rosproxies
    }
