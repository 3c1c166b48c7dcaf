"""Finds the label or annotation that a misspelt name probably means."""

import difflib
from functools import lru_cache

LEAST_SIMILARITY = 0.9
"""Least similarity (0 to 1) of a misspelt name. Below, a name may belong to another program."""
LEAST_SIMILARITY_WITH_PREFIX = 0.75
"""Least similarity of a name that begins like the operator's names."""


def nearest(name: str, known: tuple[str, ...], cutoff: float) -> str:
    """Return the most similar known name, ignoring case; empty if all are below ``cutoff``."""
    # The similarity is twice the number of equal characters, divided by both lengths together
    # (difflib). So a longer name stays below the cutoff, even if it contains a known name.
    longest = (2 / cutoff - 1) * max(map(len, known))
    return _nearest(name.lower(), known, cutoff) if len(name) <= longest else ""


def unknown_name(shown: str, near: str, known: str) -> str:
    """Say that a name is unknown. ``near`` is the name that is probably meant, or empty."""
    fix = f"Did you mean {near}?" if near else f"Known: {known}"
    return f"{shown} is unknown and ignored. {fix}"


@lru_cache(maxsize=1024)
def _nearest(name: str, known: tuple[str, ...], cutoff: float) -> str:
    """Return the most similar known name. Cached: hundreds of objects have the same few names."""
    return next(iter(difflib.get_close_matches(name, known, n=1, cutoff=cutoff)), "")
