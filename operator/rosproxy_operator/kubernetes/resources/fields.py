"""A strict reader of users' objects: the first invalid field raises `InvalidField`.

msgspec reads the proxy's documents, but its errors neither name a field as Kubernetes does nor give
a fix.
"""

from collections.abc import Mapping
from typing import Any, TypeVar

import msgspec

from rosproxy_operator.common.problem import Fault
from rosproxy_operator.kubernetes.resources.checks import quoted

N = TypeVar("N", int, float)
V = TypeVar("V")
_EMPTY_MAP: Mapping[str, Any] = {}


class InvalidField(Exception):
    """An object is unusable. The fault has the field, the problem and the fix."""

    def __init__(self, text: str, fix: str = "") -> None:
        self.fault = Fault(text, fix)
        super().__init__(str(self.fault))


class Field(msgspec.Struct, frozen=True):
    """A field of an object. ``value`` is None if the field is missing.

    ``path`` names the field as Kubernetes does, for example ``spec.peers[0]``. All methods except
    `error` raise InvalidField if the value has another type, or is out of bounds. For a missing
    field, the methods return the default, or else an empty value.
    """

    path: str
    value: Any

    def error(self, problem: str, fix: str) -> InvalidField:
        """Return the error to raise for this field."""
        return InvalidField(f"{self.path}: {quoted(self.value)} {problem}", fix)

    def __getitem__(self, key: str) -> "Field":
        return Field(f"{self.path}.{key}", self.map().get(key))

    def map(self, default: Mapping[str, Any] = _EMPTY_MAP) -> Mapping[str, Any]:
        """Return the value as a map, without a check of its entries."""
        return self._checked(dict, default, "a map of fields")

    def texts(self) -> dict[str, str]:
        """Return the value as a map of texts."""
        return {key: self[key].text() for key in self.map()}

    def items(self) -> list["Field"]:
        """Return the entries of a list as fields. A null entry is invalid."""
        fields = [
            Field(f"{self.path}[{i}]", v) for i, v in enumerate(self._checked(list, [], "a list"))
        ]
        for field in fields:
            if field.value is None:
                raise field.error("is not valid", "Remove the entry")
        return fields

    def text(self, default: str = "") -> str:
        """Return the value as a text."""
        return self._checked(str, default, "a text, in quotes")

    def boolean(self) -> bool:
        """Return the value as a boolean. The default is False."""
        return self._checked(bool, False, "true or false")

    def number(self, default: N, least: int, most: int) -> N:
        """Return the value as a number from ``least`` to ``most``, of the type of ``default``."""
        if self.value is None:
            return default
        kind = type(default)
        # In Python, bool is a subclass of int.
        fits = isinstance(self.value, int | kind) and not isinstance(self.value, bool)
        if not fits or not least <= self.value <= most:
            expected = {int: "an integer", float: "a number"}[kind]
            raise self.error("is not valid", f"Write {expected} from {least} to {most}")
        return kind(self.value)

    def one_of(self, allowed: Mapping[str, V], default: str) -> V:
        """Return the value that ``allowed`` has for the text. Another text is invalid.

        So a missing field is invalid unless ``allowed`` has the default.
        """
        text = self.text(default)
        if text not in allowed:
            fix = f"Write one of {', '.join(sorted(filter(None, allowed)))}"
            raise self.error("is unknown", fix)
        return allowed[text]

    def _checked(self, type: type[V], default: V, expected: str) -> V:
        if self.value is None:
            return default
        if not isinstance(self.value, type):
            raise self.error("is not valid", f"Write {expected}")
        return self.value


def stripped(obj: Any) -> Any:
    """Return a copy of JSON without blanks around texts, and without null entries of maps."""
    if isinstance(obj, str):
        return obj.strip()
    if isinstance(obj, Mapping):
        return {key: stripped(value) for key, value in obj.items() if value is not None}
    return [stripped(child) for child in obj] if isinstance(obj, list | tuple) else obj
