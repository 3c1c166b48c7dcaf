"""The document of a page after an update, as the page's script makes it."""

from typing import Any

Json = dict[str, Any]


def apply_update(before: Json, update: Json) -> Json:
    """The document that an update of `rosproxy.page.changes.changes` makes of ``before``."""
    after = {**before, **update}
    for table in ("nodes", "links"):
        rows = {**before[table], **update.get(table, {})}
        after[table] = {key: row for key, row in rows.items() if row is not None}
    return after
