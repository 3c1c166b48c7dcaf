"""The layer's requirements of the machine, and the message for a missing requirement."""

from __future__ import annotations

import importlib.util
import os
import shutil
from pathlib import Path

_PROGRAMS = (
    *("roscore", "rostopic", "rosbag", "g++", "pkg-config"),
    *("ip", "nft", "conntrack", "setcap", "sysctl", "unshare"),
)
_FILES = (
    "/usr/include/ros/ros.h",
    "/usr/include/actionlib/TwoIntsAction.h",
    "/usr/include/topic_tools/MuxSelect.h",
    "/usr/lib/topic_tools/relay",
    "/usr/lib/python3/dist-packages/actionlib",
    "/usr/lib/python3/dist-packages/topic_tools",
    "/usr/lib/python3/dist-packages/geometry_msgs",
)


def missing(with_proxy: bool) -> str | None:
    """The obstacle for this layer with the command against it, or None."""
    gone = [name for name in _PROGRAMS if shutil.which(name) is None]
    gone += [name for name in _FILES if not Path(name).exists()]
    if gone:
        names = ", ".join(gone)
        return f"this layer needs ROS 1: run `scripts/install-ros.sh` as root (missing: {names})"
    if os.geteuid() != 0:
        return "this layer makes network namespaces: run it as root (`make test-all LAYERS=ros`)"
    if with_proxy and importlib.util.find_spec("rosproxy") is None:
        return "rosproxy is not installed in this Python: run `make venv`"
    return None
