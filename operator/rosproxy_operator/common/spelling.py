"""The name that somebody may have meant, for names of labels and annotations."""

import difflib
from functools import lru_cache

VERY_NEAR = 0.9
NEAR = 0.75
"""How near a name is that can hardly be another program's; and one that begins as ours do."""


def nearest(name: str, known: tuple[str, ...], cutoff: float) -> str:
    """The known name that is spelt much like a name, whatever its case; empty if none is."""
    # Of a name that is twice as long as another one the ratio to that is below 0.67.
    longest = 2 * max(map(len, known))
    return _nearest(name.lower(), known, cutoff) if len(name) <= longest else ""


@lru_cache(maxsize=1024)
def _nearest(name: str, known: tuple[str, ...], cutoff: float) -> str:
    """The same, cached: hundreds of objects have the same few names."""
    return next(iter(difflib.get_close_matches(name, known, n=1, cutoff=cutoff)), "")
