"""How a ROS master checks and canonicalizes what it is called with."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rosproxy.demo.names import ANY_TYPE, resolve

Validator = Callable[[str, Any, str], Any]
"""(parameter name, value, caller_id) -> canonical value; raises Invalid."""


class Invalid(Exception):
    """A parameter that the master doesn't take; the text is what the caller gets to read."""


def _text(name: str, value: Any) -> str:
    if not isinstance(value, str):
        raise Invalid(f"ERROR: parameter [{name}] must be a string")
    return value


def anything(_name: str, value: Any, _caller: str) -> Any:
    """Take any value as it is."""
    return value


def key(name: str, value: Any, caller: str) -> str:
    """Resolve a parameter key."""
    if not value:
        raise Invalid(f"ERROR: parameter [{name}] must be specified and non-empty")
    return resolve(_text(name, value), caller)


def search_key(name: str, value: Any, _caller: str) -> str:
    """Take a parameter key unresolved, to search upwards for it; private ones can't be."""
    if not value or _text(name, value).startswith("~") or not value.strip("/"):
        raise Invalid("invalid key")
    return str(value)


def graph_name(name: str, value: Any, caller: str) -> str:
    """Resolve the name of a node, topic or service."""
    if not value or not isinstance(value, str):
        raise Invalid(f"ERROR: parameter [{name}] must be a non-empty string")
    if ":" in value or " " in value:
        raise Invalid(f"ERROR: parameter [{name}] contains illegal chars")
    return resolve(value, caller)


def resource(name: str, value: Any, caller: str) -> str:
    """Resolve the name of a topic or service, which can't be the root."""
    resolved = graph_name(name, value, caller)
    if value == "/":
        raise Invalid(f"ERROR: parameter [{name}] cannot be the global namespace")
    return resolved


def subgraph(name: str, value: Any, caller: str) -> str:
    """Resolve a namespace; an empty one means everything."""
    return resolve(value, caller) if _text(name, value) else ""


def api(name: str, value: Any, _caller: str) -> str:
    """Take the address of a node or service."""
    if not value or not isinstance(value, str):
        raise Invalid(f"ERROR: parameter [{name}] is not an XMLRPC URI")
    if not value.startswith(("http://", "rosrpc://")):
        raise Invalid(f"ERROR: parameter [{name}] is not an RPC URI")
    return value


def type_name(name: str, value: Any, _caller: str) -> str:
    """Take a message type: `package/Name`, or `*` for any."""
    if value == ANY_TYPE:
        return ANY_TYPE
    if not value or not isinstance(value, str):
        raise Invalid(f"ERROR: parameter [{name}] must be a non-empty string")
    if value.count("/") != 1:
        raise Invalid(f"ERROR: parameter [{name}] is not a valid package resource name")
    return value
