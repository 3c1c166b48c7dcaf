"""Bounds of all proxies, from options of the operator. ``rosproxy run`` has the same options."""

from collections.abc import Mapping
from typing import Any

import msgspec

from rosproxy.shared.setting_kinds import declared
from rosproxy.shared.settings import Settings

OPTION_PREFIX = "proxy-"
"""The prefix of the operator's options for the bounds of proxies."""
_DEFAULTS = {setting.field: setting.default for setting in declared(Settings)}


class ProxyBounds(msgspec.Struct, frozen=True):
    """Bounds of each proxy, in MiB and in connections. The defaults are the proxy's defaults."""

    max_buffered: int = _DEFAULTS["max_buffered"]
    max_body: int = _DEFAULTS["max_body"]
    max_connections_per_source: int = _DEFAULTS["max_connections_per_source"]
    max_connections_per_lease: int = _DEFAULTS["max_connections_per_lease"]


OWN_BOUNDS = ProxyBounds()
"""The bounds of a proxy without options."""


def make_proxy_bounds(options: Mapping[str, Any]) -> ProxyBounds:
    """Return the bounds from options, by parameter name such as ``proxy_max_body``."""
    return ProxyBounds(*(options[f"proxy_{name}"] for name in ProxyBounds.__struct_fields__))
