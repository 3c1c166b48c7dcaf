"""The configuration of the router that has the links to other sites.

The router dials other sites, and listens for other sites, by TLS or QUIC with certificates of both
sides. It also dials the hub. zenoh reads certificates only when a router opens. So a change of
certificates restarts this router alone, and all other sessions stay.

The limits of topics and the rules of ``--zenoh-link-policy`` hold for what passes by TLS and QUIC.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.policy.layers import PolicyLayer
from rosproxy.shared.setting_kinds import (
    LINK_PROTOCOLS,
    Credentials,
    LinkPort,
    SiteLink,
    TopicLimit,
)
from rosproxy.shared.zenoh_rules.key_expressions import data_keys
from rosproxy.zenoh.access_control import AT_LINKS, access_control
from rosproxy.zenoh.router_configs import LEASE, RouterConfig, router_config, tls_values

_HUB_RETRY = "#retry_period_init_ms=50"
"""The router opens before the hub. Without this value, the second try would follow after 1 s."""


@dataclass(frozen=True, slots=True)
class LinkPlan:
    """The links to other sites: the sites to dial, the port for other sites, limits and rules."""

    bind: str
    dialed: Sequence[SiteLink]
    listen: LinkPort | None
    limits: Sequence[TopicLimit]
    policy: Sequence[PolicyLayer]

    def config(self, credentials: Credentials | None, hub_socket: str) -> RouterConfig:
        """The configuration of the router. Raises ValueError as `check_layers` does.

        Without credentials, the router has no links yet.
        """
        to_hub = f"{hub_socket}{_HUB_RETRY}"
        if credentials is None:
            return router_config([], [to_hub])
        listen = self.listen
        at = [f"{listen.protocol}/{HostPort(self.bind, listen.port)}"] if listen else []
        own: dict[str, object] = {
            # Otherwise a key that zenoh cannot use would end the routers of all containers.
            "listen/exit_on_failure": False,
            "listen/timeout_ms": -1,
            **tls_values(credentials),
            "transport/link/tls/close_link_on_expiration": True,
            **LEASE,
        }
        if access := access_control(self.policy, AT_LINKS):
            own["access_control"] = access
        if self.limits:
            own["downsampling"] = [_downsampling(self.limits)]
        return router_config(at, [to_hub, *map(str, self.dialed)], own)


def _downsampling(limits: Sequence[TopicLimit]) -> dict[str, object]:
    """The value for zenoh. The first rule that matches a key counts."""
    return {
        "id": "limits",
        "link_protocols": [*LINK_PROTOCOLS],
        "flows": ["egress"],
        "messages": ["put", "delete"],
        "rules": [
            {"key_expr": key, "freq": limit.rate_hz}
            for limit in limits
            for key in data_keys(limit.glob)
        ],
    }
