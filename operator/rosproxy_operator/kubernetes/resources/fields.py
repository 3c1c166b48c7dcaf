"""What a user writes, read strictly: the first field that does not fit is refused by its name.

Not by msgspec, which reads the proxy's documents: its messages neither name a field as Kubernetes
does nor give a fix.
"""

from collections.abc import Mapping
from typing import Any, TypeVar

import msgspec

from rosproxy_operator.kubernetes.resources.checks import quoted

N = TypeVar("N", int, float)
V = TypeVar("V")
_NOTHING: Mapping[str, Any] = {}


class InvalidField(Exception):
    """Why an object can't be used: which field, what is wrong, and what to do."""


class Field(msgspec.Struct, frozen=True):
    """A part of an object, None if it is not given; ``path`` names it as Kubernetes does.

    All methods but `error` raise InvalidField if it is not what they are to give.
    """

    path: str
    value: Any

    def error(self, problem: str, fix: str) -> InvalidField:
        """The error to raise for it: what is wrong, and what to do."""
        return InvalidField(f"{self.path}: {quoted(self.value)} {problem}. {fix}")

    def __getitem__(self, key: str) -> "Field":
        return Field(f"{self.path}.{key}", self.map().get(key))

    def map(self, default: Mapping[str, Any] = _NOTHING) -> Mapping[str, Any]:
        """A map of anything."""
        return self._checked(dict, default, "a map of fields")

    def texts(self) -> dict[str, str]:
        """A map of texts."""
        return {key: self[key].text() for key in self.map()}

    def items(self) -> list["Field"]:
        """The fields of a list."""
        fields = [
            Field(f"{self.path}[{i}]", v) for i, v in enumerate(self._checked(list, [], "a list"))
        ]
        for field in fields:
            if field.value is None:
                raise field.error("is not valid", "Remove the entry")
        return fields

    def text(self, default: str = "") -> str:
        """A text."""
        return self._checked(str, default, "a text, in quotes")

    def boolean(self) -> bool:
        """True or false, which is the default."""
        return self._checked(bool, False, "true or false")

    def number(self, default: N, least: int, most: int) -> N:
        """A number of the type that the default has, within bounds."""
        if self.value is None:
            return default
        kind = type(default)  # bool is excluded below, since it is a kind of int in Python
        fits = isinstance(self.value, int | kind) and not isinstance(self.value, bool)
        if not fits or not least <= self.value <= most:
            expected = {int: "an integer", float: "a number"}[kind]
            raise self.error("is not valid", f"Write {expected} from {least} to {most}")
        return kind(self.value)

    def one_of(self, allowed: Mapping[str, V], default: str) -> V:
        """What the text stands for, which must be one of those that are allowed."""
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
    """The same without blanks around its texts; null in a map is as if it were not given."""
    if isinstance(obj, str):
        return obj.strip()
    if isinstance(obj, Mapping):
        return {key: stripped(value) for key, value in obj.items() if value is not None}
    return [stripped(child) for child in obj] if isinstance(obj, list | tuple) else obj
