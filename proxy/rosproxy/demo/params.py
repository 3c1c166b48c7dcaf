"""The parameter server: a tree of values, and who has to hear of a change."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator
from typing import Any

from rosproxy.demo.names import canonical, namespace

UNSET: dict[str, Any] = {}
"""What subscribers are told of a parameter that is not there."""


def _parts(key: str) -> list[str]:
    return [part for part in key.split("/") if part]


def _leaves(prefix: str, tree: dict[str, Any]) -> Iterator[str]:
    for name, value in tree.items():
        key = f"{prefix}/{name}"
        if isinstance(value, dict):
            yield from _leaves(key, value)
        else:
            yield key


class ParamTree:
    """Parameters by global key; a key that has others below it is a namespace (a dict)."""

    def __init__(self) -> None:
        self._root: dict[str, Any] = {}

    def get(self, key: str) -> Any:
        """Return a copy of the value or the subtree at `key`; raises KeyError."""
        return copy.deepcopy(self._find(key))

    def _find(self, key: str) -> Any:
        value: Any = self._root
        for part in _parts(key):
            if not isinstance(value, dict):
                raise KeyError(key)
            value = value[part]
        return value

    def has(self, key: str) -> bool:
        """Tell whether something is set at `key`."""
        try:
            self._find(key)
        except KeyError:
            return False
        return True

    def set(self, key: str, value: Any) -> None:
        """Set `key` to a copy of `value`, replacing all below it; raises TypeError for the root."""
        value = copy.deepcopy(value)
        parts = _parts(key)
        if not parts:
            self._set_root(value)
            return
        tree = self._root
        for part in parts[:-1]:
            if not isinstance(tree.get(part), dict):
                tree[part] = {}
            tree = tree[part]
        tree[parts[-1]] = value

    def _set_root(self, value: Any) -> None:
        if not isinstance(value, dict):
            raise TypeError("cannot set root of parameter tree to non-dictionary")
        self._root = value

    def delete(self, key: str) -> None:
        """Delete `key` and all below it; raises KeyError."""
        parts = _parts(key)
        if not parts:
            raise KeyError("cannot delete root of parameter tree")
        parent = self._find("/".join(parts[:-1]))
        if not isinstance(parent, dict):
            raise KeyError(key)
        del parent[parts[-1]]

    def names(self) -> list[str]:
        """Return the keys of all values."""
        return list(_leaves("", self._root))

    def search(self, caller_id: str, key: str) -> str | None:
        """Look for `key` in the caller's namespace and upwards; None when nobody has it."""
        if key.startswith("/"):
            return key if self.has(key) else None
        first = _parts(key)[0]
        place = canonical(caller_id)
        while not self.has(f"{place}/{first}"):
            if place == "/":
                return None
            place = canonical(namespace(place))
        return canonical(f"{place}/{key}")


def updates(subscribed: Iterable[str], key: str, value: Any) -> Iterator[tuple[str, str, Any]]:
    """Yield (subscribed key, key to announce, value to announce) for a change of `key`.

    Keys are as ROS announces them, with a trailing slash. A subscriber above the changed key
    hears of the change as it is; one below hears of its own part, or that it is gone. When a
    plain value takes the place of a namespace, those below hear nothing: so does ROS's master.
    """
    changed = _slashed(key)
    for subscription in subscribed:
        if changed.startswith(subscription):
            yield subscription, changed, value
        elif isinstance(value, dict) and subscription.startswith(changed):
            yield subscription, subscription, _part_of(value, subscription[len(changed) :])


def _slashed(key: str) -> str:
    return key if key == "/" else canonical(key) + "/"


def _part_of(value: Any, path: str) -> Any:
    for part in _parts(path):
        if not isinstance(value, dict) or part not in value:
            return UNSET
        value = value[part]
    return value


def subscription_key(key: str) -> str:
    """Return the form under which a subscription to `key` is kept: with a trailing slash."""
    return _slashed(key)
