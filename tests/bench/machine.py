"""The machine before it is put to work, and the versions of what runs on it."""

from __future__ import annotations

import os
import platform
import shutil
import sys
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path
from subprocess import getoutput

_VERSIONS = {
    "socat": "socat -V | sed -n 's/^socat version \\([^ ]*\\).*/\\1/p'",
    "haproxy": "haproxy -v | sed -n '1s/HAProxy version \\([^ ]*\\).*/\\1/p'",
    "nginx": "nginx -v 2>&1 | sed 's/.*nginx.//'",
    "nft": "nft --version | cut -d' ' -f2",
}


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
        "peers": ", ".join(f"{name} {version(name)}" for name in _VERSIONS),
    }


def processor() -> str:
    return getoutput("sed -n '/^model name/{s/.*: //p;q}' /proc/cpuinfo") or platform.machine()


def memory() -> str:
    kib = int(Path("/proc/meminfo").read_text().split()[1])
    return f"{kib / 2**20:.0f} GiB"


def version(name: str) -> str:
    return getoutput(_VERSIONS[name]) if shutil.which(name) else "(not installed)"
