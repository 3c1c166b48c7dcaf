"""What an administrator lets each proxy take: the options of ``rosproxy run`` of the same names."""

from collections.abc import Mapping
from typing import Any

import msgspec

PREFIX = "proxy_"
"""Before the names of the operator's options."""


class ProxyBounds(msgspec.Struct, frozen=True):
    """Bounds of each proxy, MiB and numbers of connections; the defaults are the proxy's own."""

    max_buffered: int = 32
    max_body: int = 64
    max_connections_per_source: int = 4096
    max_connections_per_lease: int = 2048


OWN_BOUNDS = ProxyBounds()


def make_proxy_bounds(options: Mapping[str, Any]) -> ProxyBounds:
    """The bounds from the values of the command line's options, by their names."""
    return ProxyBounds(*(options[f"{PREFIX}{name}"] for name in ProxyBounds.__struct_fields__))


def bound_variables(bounds: ProxyBounds) -> dict[str, str]:
    """The variables by which a proxy learns its bounds: those that are not its own."""
    own = msgspec.structs.asdict(OWN_BOUNDS)
    return {
        f"ROSPROXY_{name.upper()}": str(value)
        for name, value in msgspec.structs.asdict(bounds).items()
        if value != own[name]
    }
