"""The editor for ``kubectl edit``: ``python editor.py PATCH FILE``, with a JSON merge patch."""

import json
import sys
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]


def merged(body: Any, patch: Any) -> Any:
    """Apply a JSON merge patch (RFC 7396). None removes a key."""
    if not isinstance(patch, dict):
        return patch
    result = dict(body) if isinstance(body, dict) else {}
    for key, value in patch.items():
        if value is None:
            result.pop(key, None)
        else:
            result[key] = merged(result.get(key), value)
    return result


if __name__ == "__main__":
    patch = json.loads(Path(sys.argv[1]).read_text())
    file = Path(sys.argv[2])
    file.write_text(yaml.safe_dump(merged(yaml.safe_load(file.read_text()), patch)))
