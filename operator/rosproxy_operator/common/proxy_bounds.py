"""What an administrator lets each proxy take: the options of ``rosproxy run`` of the same names."""

from collections.abc import Mapping
from typing import Any

import msgspec

from rosproxy.setting_kinds import declared
from rosproxy.settings import Settings

PREFIX = "proxy-"
"""Before the names of the operator's options."""
_OWN = {setting.field: setting.default for setting in declared(Settings)}


class ProxyBounds(msgspec.Struct, frozen=True):
    """Bounds of each proxy, MiB and numbers of connections; the defaults are the proxy's own."""

    max_buffered: int = _OWN["max_buffered"]
    max_body: int = _OWN["max_body"]
    max_connections_per_source: int = _OWN["max_connections_per_source"]
    max_connections_per_lease: int = _OWN["max_connections_per_lease"]


OWN_BOUNDS = ProxyBounds()


def make_proxy_bounds(options: Mapping[str, Any]) -> ProxyBounds:
    """The bounds from the values of the command line's options, by their names."""
    return ProxyBounds(*(options[f"proxy_{name}"] for name in ProxyBounds.__struct_fields__))
