"""The test nodes of other client libraries, as `scripts/install-clients.sh` has built them.

All take the arguments of tests/ros/nodes/node.py, and print the same lines.
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
"""It makes its messages when it starts, of what it finds there."""


def programs() -> dict[str, tuple[str, ...]]:
    """How a node of each library is started."""
    return {
        "goroslib": (str(CACHE / "goroslib"),),
        "rosrust": (str(CACHE / "rosrust"),),
        "roslibrust": (str(CACHE / "roslibrust"),),
        "rosnodejs": ("env", *ROSNODEJS, "node", str(CACHE / "rosnodejs/node.js")),
        "foxglove": ("node", str(CACHE / "foxglove/node.js")),
        "roslisp": (str(CACHE / "roslisp"),),
    }


def missing() -> str | None:
    """What stops this layer from running and the command that mends it, or nothing."""
    gone = [name for name, words in programs().items() if not Path(words[-1]).exists()]
    if gone:
        return f"no nodes of {', '.join(gone)}: run `scripts/install-clients.sh` as root"
    return requirements.missing(with_proxy=True)
