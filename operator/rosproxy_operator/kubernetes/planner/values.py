"""Values out of objects: those of users with errors that name the field, others without any."""

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from rosproxy.net.addresses import is_loopback
from rosproxy.settings import SettingError, parse_host
from rosproxy_operator.kubernetes.planner.model import Json

_SHOWN = 80
_SUBDOMAIN = re.compile(r"[a-z0-9]([-a-z0-9]*[a-z0-9])?(\.[a-z0-9]([-a-z0-9]*[a-z0-9])?)*")
_QUALIFIED = re.compile(r"[A-Za-z0-9]([-A-Za-z0-9_.]{0,61}[A-Za-z0-9])?")


class InvalidField(Exception):
    """Why an object can't be used: which field, what is wrong, and what to do."""


def quoted(value: object) -> str:
    """A value as it may be shown: not too long, and harmless."""
    text = repr(value)
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 1]}…"


def host_problem(host: str) -> str:
    """What is wrong with a host under which outside is to reach a node; empty if nothing is."""
    try:
        parse_host("host", host)
    except SettingError:
        return f"{quoted(host)} is neither a host name nor an address"
    if is_loopback(host.strip("[]")):
        return f"{quoted(host)} means another machine to everybody else"
    return ""


def is_subdomain(text: str) -> bool:
    """Whether a text is a lower-case DNS name (RFC 1123), as Kubernetes wants names."""
    return len(text) <= 253 and _SUBDOMAIN.fullmatch(text) is not None


def is_label(text: str) -> bool:
    """Whether a text is one part of such a DNS name."""
    return len(text) <= 63 and "." not in text and is_subdomain(text)


def is_label_key(text: str) -> bool:
    """Whether a text can be the key of a label: ``name`` or ``prefix/name``."""
    prefix, slash, name = text.rpartition("/")
    return _QUALIFIED.fullmatch(name) is not None and (not slash or is_subdomain(prefix))


def is_label_value(text: str) -> bool:
    """Whether a text can be the value of a label."""
    return not text or _QUALIFIED.fullmatch(text) is not None


def part(obj: Any, *keys: str) -> Json:
    """The map that is found down some keys, empty if there is none."""
    for key in keys:
        obj = obj.get(key) if isinstance(obj, Mapping) else None
    return obj if isinstance(obj, Mapping) else {}


def parts(obj: Any, key: str) -> tuple[Json, ...]:
    """The maps in the list under a key, none if there is no list."""
    found = part(obj).get(key)
    listed = found if isinstance(found, list | tuple) else ()
    return tuple(one for one in listed if isinstance(one, Mapping))


def word(obj: Any, key: str) -> str:
    """The text under a key, empty if there is none."""
    found = part(obj).get(key)
    return found if isinstance(found, str) else ""


def number(obj: Any, key: str) -> int:
    """The integer under a key, 0 if there is none."""
    found = part(obj).get(key)
    return found if isinstance(found, int) and not isinstance(found, bool) else 0


def words(obj: Any, *keys: str) -> dict[str, str]:
    """The texts of a map, by their keys."""
    return {key: value for key, value in part(obj, *keys).items() if isinstance(value, str)}


@dataclass(frozen=True, slots=True)
class Field:
    """A field of an object that a user writes. ``path`` names it: ``spec.ports``.

    ``value`` None means that it is not given. All methods raise Unusable for another type.
    """

    path: str
    value: Any

    @property
    def given(self) -> bool:
        """Whether it is there."""
        return self.value is not None

    def wrong(self, what: str, fix: str) -> InvalidField:
        """The error to raise for this field."""
        return InvalidField(f"{self.path}: {quoted(self.value)} {what}: {fix}")

    def child(self, name: str) -> "Field":
        """A field of the map that this one is."""
        return Field(f"{self.path}.{name}", self.map().get(name))

    def map(self) -> Json:
        """The map, empty if not given."""
        if self.given and not isinstance(self.value, Mapping):
            raise self.wrong("is not a map", f"write {self.path} as a map of fields")
        return part(self.value)

    def list(self) -> tuple["Field", ...]:
        """The elements, none if not given."""
        if self.given and not isinstance(self.value, list | tuple):
            raise self.wrong("is not a list", f"write {self.path} as a list")
        return tuple(Field(f"{self.path}[{i}]", one) for i, one in enumerate(self.value or ()))

    def maps(self) -> tuple[Json, ...]:
        """The elements of a list of maps."""
        return tuple(one.map() for one in self.list())

    def text(self, default: str = "") -> str:
        """The text, without spaces around it."""
        if self.given and not isinstance(self.value, str):
            raise self.wrong("is not a text", "put it in quotes")
        return self.value.strip() if self.given else default

    def texts(self) -> dict[str, str]:
        """The map of texts."""
        return {key: self.child(key).text() for key in self.map()}

    def choice(self, allowed: Collection[str], default: str) -> str:
        """One of some words."""
        found = self.text(default)
        if found not in allowed:
            raise self.wrong("is unknown", f"write one of {', '.join(sorted(allowed))}")
        return found

    def integer(self, default: int, low: int, high: int) -> int:
        """An integer between two bounds."""
        if not self.given:
            return default
        whole = isinstance(self.value, int) and not isinstance(self.value, bool)
        if not whole or not low <= self.value <= high:
            raise self.wrong("does not fit", f"write an integer from {low} to {high}")
        return int(self.value)

    def seconds(self, default: float) -> float:
        """A time, from none to a day."""
        if not self.given:
            return default
        real = isinstance(self.value, int | float) and not isinstance(self.value, bool)
        if not real or not 0 <= self.value <= 86400:
            raise self.wrong("does not fit", "write a number of seconds from 0 to 86400")
        return float(self.value)
