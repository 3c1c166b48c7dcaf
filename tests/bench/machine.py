"""The idle machine, and the versions of all programs."""

from __future__ import annotations

import os
import platform
import shutil
import sys
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path
from subprocess import getoutput

from tests.ros2.lab import ENVIRONMENTS

_VERSIONS = {
    "socat": "socat -V | sed -n 's/^socat version \\([^ ]*\\).*/\\1/p'",
    "haproxy": "haproxy -v | sed -n '1s/HAProxy version \\([^ ]*\\).*/\\1/p'",
    "nginx": "nginx -v 2>&1 | sed 's/.*nginx.//'",
    "nft": "nft --version | cut -d' ' -f2",
}

_PINS = (("jazzy", "ros-jazzy-rclpy"), ("jazzy", "ros-fastrtps"), ("cyclone", "cyclonedds"))
"""Packages of the ROS 2 layer's environments."""


def described() -> dict[str, str]:
    loop = "uvloop" if find_spec("uvloop") else "asyncio"
    return {
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "rosproxy": getoutput("git describe --always --dirty"),
        "machine": f"{os.cpu_count()} cores of {processor()}, {memory()} of memory",
        "kernel": platform.platform(),
        "load": f"{os.getloadavg()[0]:.2f} before the run",
        "python": f"{sys.version.split()[0]} with {loop}",
        "ROS": getoutput(
            "dpkg-query -W -f '${Package} ${Version}, ' python3-rospy libroscpp4d"
        ).rstrip(", "),
        "ROS 2": ", ".join(pinned(*words) for words in _PINS),
        "other programs": ", ".join(f"{name} {version(name)}" for name in _VERSIONS),
    }


def processor() -> str:
    return getoutput("sed -n '/^model name/{s/.*: //p;q}' /proc/cpuinfo") or platform.machine()


def memory() -> str:
    kib = int(Path("/proc/meminfo").read_text().split()[1])
    return f"{kib / 2**20:.0f} GiB"


def pinned(environment: str, package: str) -> str:
    """A package with its version in an environment of the ROS 2 layer."""
    pins = ENVIRONMENTS / environment / "pins"
    lines = pins.read_text().splitlines() if pins.exists() else []
    requirements = (line.split()[0] for line in lines if line.startswith(f"{package}=="))
    return next(requirements, f"{package} (not installed)").replace("==", " ")


def version(name: str) -> str:
    return getoutput(_VERSIONS[name]) if shutil.which(name) else "(not installed)"
