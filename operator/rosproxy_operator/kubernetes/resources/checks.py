"""Checks of names, labels and hosts by Kubernetes' rules, and typed reads from JSON."""

import re

from rosproxy.shared.addresses import is_loopback
from rosproxy.shared.output.text import shorten
from rosproxy.shared.ports import PortRange
from rosproxy.shared.setting_kinds import SettingError, parse_host, parse_range
from rosproxy_operator.kubernetes.resources.model import Json

_SUBDOMAIN = re.compile(r"[a-z0-9]([-a-z0-9]*[a-z0-9])?(\.[a-z0-9]([-a-z0-9]*[a-z0-9])?)*")
_QUALIFIED = re.compile(r"[A-Za-z0-9]([-A-Za-z0-9_.]{0,61}[A-Za-z0-9])?")


def quoted(value: object) -> str:
    """Return the repr of a value, at most 80 characters long."""
    return shorten(repr(value), 80)


def host_problem(host: str) -> str:
    """Return why a text can't be an advertised host, empty if the text can.

    The check is of the form only: a host name or an address that is not loopback.
    """
    try:
        parse_host("host", host)
    except SettingError:
        return f"{quoted(host)} is neither a host name nor an address"
    if is_loopback(host.strip("[]")):
        return f"{quoted(host)} is loopback, which no other host can reach"
    return ""


def is_subdomain(text: str) -> bool:
    """Whether a text is a lower-case DNS name (RFC 1123), the form of Kubernetes' object names."""
    return len(text) <= 253 and _SUBDOMAIN.fullmatch(text) is not None


def is_label(text: str) -> bool:
    """Whether a text is a single label of a lower-case DNS name (RFC 1123)."""
    return len(text) <= 63 and "." not in text and is_subdomain(text)


def is_label_key(text: str) -> bool:
    """Whether a text can be the key of a label: ``name`` or ``prefix/name``."""
    prefix, slash, name = text.rpartition("/")
    return _QUALIFIED.fullmatch(name) is not None and (not slash or is_subdomain(prefix))


def is_label_value(text: str) -> bool:
    """Whether a text can be the value of a label."""
    return not text or _QUALIFIED.fullmatch(text) is not None


def submap(obj: Json, *keys: str) -> Json:
    """Return the map at a path of keys, empty if there is no map."""
    for key in keys:
        child = obj.get(key)
        obj = child if isinstance(child, dict) else {}
    return obj


def submaps(obj: Json, key: str) -> list[Json]:
    """Return the maps in the list under a key, empty if there is no list."""
    array = obj.get(key)
    return [child for child in array if isinstance(child, dict)] if isinstance(array, list) else []


def text_at(obj: Json, key: str) -> str:
    """Return the text under a key, empty if there is no text."""
    text = obj.get(key)
    return text if isinstance(text, str) else ""


def int_at(obj: Json, key: str) -> int:
    """Return the integer under a key, 0 if there is no integer."""
    value = obj.get(key)
    return value if type(value) is int else 0


def port_range(obj: Json, key: str) -> PortRange | None:
    """Return the port range in the text under a key, None if the text is no range."""
    try:
        return parse_range(key, text_at(obj, key))
    except SettingError:
        return None


def texts_at(obj: Json, *keys: str) -> dict[str, str]:
    """Return the texts in the map at a path of keys, by their keys."""
    return {key: value for key, value in submap(obj, *keys).items() if isinstance(value, str)}
