"""What is new in a document: only that is sent to those who have the former one."""

from typing import Any

Json = dict[str, Any]
_TABLES = ("nodes", "links")


def changes(before: Json, after: Json) -> Json:
    """What turns ``before`` into ``after``; empty if they are equal.

    Of nodes and links those that are new or differ, and None for those that are gone; of the rest
    all that differs.
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


def changed(before: Json, update: Json) -> Json:
    """The document with these changes."""
    after = {**before, **update}
    for table in _TABLES:
        rows = {**before[table], **update.get(table, {})}
        after[table] = {key: row for key, row in rows.items() if row is not None}
    return after
