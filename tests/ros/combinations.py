"""The combinations of most tests: libraries, directions, and the first to start."""

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
"""The machine of a tool, and the machine of the node in question."""

each_view = pytest.mark.parametrize(("side", "machine"), VIEWS.values(), ids=VIEWS.keys())

_LIBRARIES_SEEN = {
    "inside-about-itself": ("rospy",),
    "inside-about-inside": ("roscpp",),
    "inside-about-outside": ("rospy",),
    "outside-about-inside": LIBRARIES,
}
each_view_of_a_library = pytest.mark.parametrize(
    ("library", "side", "machine"),
    [
        (library, *VIEWS[view])
        for view, libraries in _LIBRARIES_SEEN.items()
        for library in libraries
    ],
    ids=[
        f"{library}-{view}" for view, libraries in _LIBRARIES_SEEN.items() for library in libraries
    ],
)
"""Each view, and where a tool of outside asks through the proxy each library; else in turn."""


def each_pair(first: str, second: str) -> pytest.MarkDecorator:
    """Every pair of libraries, as arguments with the two names."""
    pairs = [(a, b) for a in LIBRARIES for b in LIBRARIES]
    return pytest.mark.parametrize((first, second), pairs, ids=[f"{a}-to-{b}" for a, b in pairs])


def each_way_and_order(
    first: str, second: str, directions: tuple[str, ...] = tuple(DIRECTIONS)
) -> pytest.MarkDecorator:
    """Every pair of libraries in every direction. The first to start (``starter``) alternates.

    So in each role and direction, each library starts first once and second once, and each pair of
    libraries starts in both orders.
    """
    rows = [
        (a, b, *DIRECTIONS[way], (first, second)[(i + j + k) % 2], f"{a}-to-{b}-{way}")
        for i, a in enumerate(LIBRARIES)
        for j, b in enumerate(LIBRARIES)
        for k, way in enumerate(directions)
    ]
    return pytest.mark.parametrize(
        (first, second, "source", "sink", "starter"),
        [row[:5] for row in rows],
        ids=[f"{row[5]}-{row[4]}-first" for row in rows],
    )


def each_way_in_turn(
    first: str, second: str, directions: tuple[str, ...] = tuple(DIRECTIONS)
) -> pytest.MarkDecorator:
    """Each library in each role and direction, and each pair of libraries: half of all cases.

    For features that use messages and calls. `each_way_and_order` tries messages and calls in every
    combination, so defects of a single combination show there.
    """
    rows = [
        (a, b, *DIRECTIONS[way], f"{a}-to-{b}-{way}")
        for i, a in enumerate(LIBRARIES)
        for j, b in enumerate(LIBRARIES)
        for way in directions
        if (i == j) == (way == "outside-to-inside")
    ]
    return pytest.mark.parametrize(
        (first, second, "source", "sink"), [row[:4] for row in rows], ids=[row[4] for row in rows]
    )
