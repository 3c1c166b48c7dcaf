"""The difference between two documents. The proxy sends only this difference to open pages."""

from typing import Any

Json = dict[str, Any]
_TABLES = ("nodes", "links")


def changes(before: Json, after: Json) -> Json:
    """The update that turns ``before`` into ``after``; empty if both are equal.

    The update has the new and changed nodes and links, and None for removed nodes and links. Of the
    other fields, the update has each changed field.
    """
    update: Json = {}
    for table in _TABLES:
        old = before[table]
        new = after[table]
        rows = {key: row for key, row in new.items() if old.get(key) != row}
        rows |= dict.fromkeys(old.keys() - new.keys())
        if rows:
            update[table] = rows
    keys = before.keys() | after.keys()
    update |= {
        key: after.get(key) for key in keys.difference(_TABLES) if before.get(key) != after.get(key)
    }
    return update
