"""The combinations that most tests run in: libraries, directions, and who is first."""

from __future__ import annotations

import pytest

LIBRARIES = ("rospy", "roscpp")

DIRECTIONS = {
    "inside-to-outside": ("c1", "out"),
    "outside-to-inside": ("out", "c1"),
    "inside-to-inside": ("c1", "c2"),
}
"""From where to where: publisher and subscriber, or server and client."""

each_direction = pytest.mark.parametrize(
    ("source", "sink"), DIRECTIONS.values(), ids=DIRECTIONS.keys()
)
each_library = pytest.mark.parametrize("library", LIBRARIES)
each_side = pytest.mark.parametrize("side", ["c1", "out"], ids=["inside", "outside"])

VIEWS = {
    "inside-about-itself": ("c1", "c1"),
    "inside-about-inside": ("c1", "c2"),
    "inside-about-outside": ("c1", "out"),
    "outside-about-inside": ("out", "c1"),
}
"""Where a tool runs, and where the node is that it is asked about."""

each_view = pytest.mark.parametrize(("side", "where"), VIEWS.values(), ids=VIEWS.keys())


def each_pair(first: str, second: str) -> pytest.MarkDecorator:
    """Every pair of libraries, as arguments with the two names."""
    pairs = [(a, b) for a in LIBRARIES for b in LIBRARIES]
    return pytest.mark.parametrize((first, second), pairs, ids=[f"{a}-to-{b}" for a, b in pairs])
