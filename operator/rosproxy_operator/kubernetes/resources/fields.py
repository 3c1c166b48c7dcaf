"""What a user writes, read strictly: the first field that does not fit is refused by its name.

Not by msgspec, which the proxy's documents are read with: what it says of a field is neither named
as Kubernetes names it nor tells what to do.
"""

from collections.abc import Mapping
from typing import Any, TypeVar

import msgspec

from rosproxy_operator.kubernetes.resources.values import quoted

N = TypeVar("N", int, float)
V = TypeVar("V")
_NOTHING: Mapping[str, Any] = {}


class InvalidField(Exception):
    """Why an object can't be used: which field, what is wrong, and what to do."""


class Field(msgspec.Struct, frozen=True):
    """A part of an object, None if it is not given; ``path`` names it as Kubernetes does.

    All methods but `refused` raise InvalidField if it is not what they are to give.
    """

    path: str
    value: Any

    def refused(self, what: str, fix: str) -> InvalidField:
        """The error to raise for it: what is wrong, and what to do."""
        return InvalidField(f"{self.path}: {quoted(self.value)} {what}: {fix}")

    def __getitem__(self, key: str) -> "Field":
        return Field(f"{self.path}.{key}", self.map().get(key))

    def map(self, default: Mapping[str, Any] = _NOTHING) -> Mapping[str, Any]:
        """A map of anything."""
        return self._of(dict, default, "a map of fields")

    def texts(self) -> dict[str, str]:
        """A map of texts."""
        return {key: self[key].text() for key in self.map()}

    def each(self) -> list["Field"]:
        """What a list holds."""
        found = [
            Field(f"{self.path}[{i}]", one) for i, one in enumerate(self._of(list, [], "a list"))
        ]
        for one in found:
            if one.value is None:
                raise one.refused("does not fit", "leave it out")
        return found

    def text(self, default: str = "") -> str:
        """A text."""
        return self._of(str, default, "a text, in quotes")

    def truth(self) -> bool:
        """True or false, which is the default."""
        return self._of(bool, False, "true or false")

    def number(self, default: N, least: int, most: int) -> N:
        """A number of the type that the default has, within bounds."""
        if self.value is None:
            return default
        kind = type(default)
        fits = isinstance(self.value, int | kind) and not isinstance(self.value, bool)
        if not fits or not least <= self.value <= most:
            word = {int: "an integer", float: "a number"}[kind]
            raise self.refused("does not fit", f"write {word} from {least} to {most}")
        return kind(self.value)

    def one_of(self, allowed: Mapping[str, V], default: str) -> V:
        """What one of some words stands for."""
        found = self.text(default)
        if found not in allowed:
            fix = f"write one of {', '.join(sorted(filter(None, allowed)))}"
            raise self.refused("is unknown", fix)
        return allowed[found]

    def _of(self, type: type[V], default: V, word: str) -> V:
        if self.value is None:
            return default
        if not isinstance(self.value, type):
            raise self.refused("does not fit", f"write {word}")
        return self.value


def bare(obj: Any) -> Any:
    """The same without blanks around its texts; null in a map is as if it were not given."""
    if isinstance(obj, str):
        return obj.strip()
    if isinstance(obj, Mapping):
        return {key: bare(value) for key, value in obj.items() if value is not None}
    return [bare(one) for one in obj] if isinstance(obj, list | tuple) else obj
