"""The bodies of the admin endpoint's POST calls, read and checked."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from rosproxy.net.addresses import parse_address

_NAME = re.compile(r"[\w.-]{1,253}")


class BodyError(ValueError):
    """A body that can't be used; the message names the field and says what it must be."""

    def __init__(self, field: str, problem: str) -> None:
        super().__init__(f"{field}: {problem}")


@dataclass(frozen=True, slots=True)
class Arrival:
    """A container on an inside network: its IP address there, and the host names it goes by."""

    address: str
    names: frozenset[str] = frozenset()

    def is_called(self, host: str) -> bool:
        """Whether a host name or address in a URI may mean this container."""
        return host == self.address or host.lower() in self.names


@dataclass(frozen=True, slots=True)
class ContainerNews:
    """What has become of containers.

    ``gone``: addresses that no container has any more. ``moved``: old address to new address.
    ``arrived``: containers that may have nodes which registered before the proxy was there.
    """

    gone: tuple[str, ...] = ()
    moved: Mapping[str, str] = field(default_factory=dict)
    arrived: tuple[Arrival, ...] = ()


def read_news(body: Any) -> ContainerNews:
    """The body of ``POST /containers``. Raises BodyError."""
    fields = _object("the body", body, ("gone", "moved", "arrived"))
    moved = _object("moved", fields.get("moved", {}))
    return ContainerNews(
        gone=tuple(_address(f"gone[{i}]", a) for i, a in _listed("gone", fields)),
        moved=dict(_move(old, new) for old, new in moved.items()),
        arrived=tuple(_arrival(f"arrived[{i}]", a) for i, a in _listed("arrived", fields)),
    )


def read_master_address(body: Any) -> str:
    """The body of ``POST /master-address``: the address. Raises BodyError."""
    return _address("address", _object("the body", body, ("address",)).get("address"))


def read_nothing(body: Any) -> None:
    """The body of a call that takes none: nothing, or an empty object. Raises BodyError."""
    _object("the body", body, ("",))


def _move(old: str, new: Any) -> tuple[str, str]:
    return _address("moved", old), _address(f"moved[{old[:40]!r}]", new)


def _arrival(field: str, body: Any) -> Arrival:
    fields = _object(field, body, ("address", "names"))
    names = [_name(f"{field}.names[{i}]", n) for i, n in _listed("names", fields, field)]
    return Arrival(_address(f"{field}.address", fields.get("address")), frozenset(names))


def _object(field: str, value: Any, known: tuple[str, ...] = ()) -> dict[str, Any]:
    """A JSON object; only with ``known`` fields, unless that is empty."""
    if not isinstance(value, dict):
        raise BodyError(field, f"must be a JSON object, not {_kind(value)}")
    unknown = [name for name in value if known and name not in known]
    if unknown:
        allowed = ", ".join(filter(None, known)) or "none"
        raise BodyError(field, f"unknown field {unknown[0][:40]!r}; known: {allowed}")
    return value


def _listed(name: str, fields: Mapping[str, Any], where: str = "") -> list[tuple[int, Any]]:
    value = fields.get(name, [])
    if not isinstance(value, list):
        raise BodyError(f"{where}.{name}".lstrip("."), f"must be a list, not {_kind(value)}")
    return list(enumerate(value))


def _address(field: str, value: Any) -> str:
    address = parse_address(value) if isinstance(value, str) else None
    if address is None:
        raise BodyError(field, f"must be an IP address such as 172.18.0.5, not {_kind(value)}")
    return address


def _name(field: str, value: Any) -> str:
    if not isinstance(value, str) or not _NAME.fullmatch(value):
        raise BodyError(field, f"must be a host name, not {_kind(value)}")
    return value.lower()


def _kind(value: Any) -> str:
    """How a message names a value: text is quoted, the rest is told by its type."""
    if isinstance(value, str):
        return repr(value[:40])
    kinds = {dict: "an object", list: "a list", bool: "true or false", type(None): "null"}
    return kinds.get(type(value), "a number")
