"""The test nodes of other client libraries, built by `scripts/install-clients.sh`.

All programs take the arguments of tests/ros/nodes/node.py, and print the same lines.
"""

from __future__ import annotations

import os
from pathlib import Path

from tests.ros import requirements

CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rosproxy/clients"

_PACKAGES = ("std_msgs", "rosgraph_msgs", "roscpp", "topic_tools")
ROSNODEJS = (
    "CMAKE_PREFIX_PATH=/usr",
    f"ROS_PACKAGE_PATH={':'.join(f'/usr/share/{name}' for name in _PACKAGES)}",
)
"""rosnodejs generates messages at its start from these definitions."""


def programs() -> dict[str, tuple[str, ...]]:
    """The command line of a node for each library."""
    return {
        "goroslib": (str(CACHE / "goroslib"),),
        "rosrust": (str(CACHE / "rosrust"),),
        "roslibrust": (str(CACHE / "roslibrust"),),
        "rosnodejs": ("env", *ROSNODEJS, "node", str(CACHE / "rosnodejs/node.js")),
        "foxglove": ("node", str(CACHE / "foxglove/node.js")),
        "roslisp": (str(CACHE / "roslisp"),),
    }


def missing() -> str | None:
    """The obstacle for this layer with the command against it, or None."""
    gone = [name for name, words in programs().items() if not Path(words[-1]).exists()]
    if gone:
        return f"no nodes of {', '.join(gone)}: run `scripts/install-clients.sh` as root"
    return requirements.missing(with_proxy=True)
