"""Objects of the API server into typed structures, by msgspec.

msgspec it is, and not pydantic: all pods of a cluster's nodes are converted with every look, in one
call of C each; it passes over fields that are not named here, newer ones too; and what it makes is
frozen and compares by value, as all that the planner works on.

There are two ways. `strict` is for what a user writes, a RosProxy's spec: the first field that does
not fit is refused by its name. `lenient` is for objects that are not ours and that the API server
has checked: what does not fit is as if it were not there.
"""

import re
from collections.abc import Mapping
from typing import Any, TypeVar

import msgspec

from rosproxy.telemetry.text import shorten

T = TypeVar("T")
Path = tuple[str | int | None, ...]
"""The way to a part of an object: keys, indexes, and None for some value of a map of texts."""
_AT = re.compile(r"^(?P<what>.*?)(?: - at `\$(?P<path>.*)`)?$", re.S)
_STEP = re.compile(r"\.([^.\[]+)|\[(\d+)\]|\[\.\.\.\]")
_WORDS = {
    "`int`": "an integer",
    "`float`": "a number",
    "`str`": "a text, in quotes",
    "`object`": "a map of fields",
    "`array`": "a list",
    "`bool`": "true or false",
}
_SHOWN = 80


class ApiFields(msgspec.Struct, frozen=True, rename="camel"):
    """Fields of an API object, by their names there in snake case."""


class InvalidField(Exception):
    """Why an object can't be used: which field, what is wrong, and what to do."""


def invalid_field(path: str, value: object, what: str, fix: str) -> InvalidField:
    """The error to raise for a field. ``path`` names it as Kubernetes does: ``spec.ports``."""
    return InvalidField(f"{path}: {quoted(value)} {what}: {fix}")


def quoted(value: object) -> str:
    """A value as it may be shown: not too long, and harmless."""
    return shorten(repr(value), _SHOWN)


def strict(obj: Any, type: type[T], name: str) -> T:
    """The fields of the object that is called ``name``; null is as if not given, texts are bare.

    Raises InvalidField.
    """
    bare = _bare(obj)
    try:
        return msgspec.convert({} if bare is None else bare, type)
    except msgspec.ValidationError as error:
        what, path = _parsed(error)
        where, value = _found(bare, path, name)
        expected = what.removeprefix("Expected ").partition(", got")[0]
        for word, plain in _WORDS.items():
            expected = expected.replace(word, plain)
        raise invalid_field(where, value, "does not fit", f"write {expected}") from None


def lenient(obj: Any, type: type[T]) -> T:
    """The fields of an object that fit."""
    while True:
        try:
            return msgspec.convert(obj, type)
        except msgspec.ValidationError as error:
            obj = _without(obj, _parsed(error)[1])


def _bare(obj: Any) -> Any:
    if isinstance(obj, str):
        return obj.strip()
    if isinstance(obj, Mapping):
        return {key: _bare(value) for key, value in obj.items() if value is not None}
    return [_bare(one) for one in obj] if isinstance(obj, list | tuple) else obj


def _parsed(error: msgspec.ValidationError) -> tuple[str, Path]:
    """What is wrong, and where."""
    found = _AT.match(str(error))
    assert found is not None  # noqa: S101 - it matches anything
    steps = _STEP.finditer(found["path"] or "")
    return found["what"], tuple(one[1] or (int(one[2]) if one[2] else None) for one in steps)


def _found(obj: Any, path: Path, name: str) -> tuple[str, Any]:
    """The name of the part of an object that a path leads to, and its value."""
    for step in path:
        key = step if step is not None else _no_text(obj)
        name += f"[{key}]" if isinstance(key, int) else f".{key}"
        obj = obj[key]
    return name, obj


def _no_text(texts: Mapping[str, Any]) -> str:
    return next(key for key, value in texts.items() if not isinstance(value, str))


def _without(obj: Any, path: Path) -> Any:
    """The object without the part that a path leads to."""
    if not path:
        return {}
    step, rest = path[0], path[1:]
    if step is None:
        return {key: value for key, value in obj.items() if isinstance(value, str)}
    if isinstance(step, int):
        changed = [_without(obj[step], rest)] if rest else []
        return [*obj[:step], *changed, *obj[step + 1 :]]
    others = {key: value for key, value in obj.items() if key != step}
    return {**others, step: _without(obj[step], rest)} if rest else others
