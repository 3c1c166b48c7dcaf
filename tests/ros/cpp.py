"""Compiles the C++ test nodes, once for each version of the sources and of ROS.

    python -m tests.ros.cpp

compiles in advance.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import subprocess
from functools import cache
from pathlib import Path

NODES = Path(__file__).parent / "nodes"
CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rosproxy/ros-nodes"
"""Beside the caches of other tests, so that a fresh clone need not compile."""
PACKAGES = ("roscpp", "std_msgs", "actionlib", "topic_tools")
FLAGS = ("-std=c++17", "-O1", "-w", "-DBOOST_BIND_GLOBAL_PLACEHOLDERS")


def compiled_node() -> Path:
    """The path of the C++ node program, compiled now if the sources have changed."""
    CACHE.mkdir(parents=True, exist_ok=True)
    binary = CACHE / f"node-{_digest()}"
    with (CACHE / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # several processes may run tests
        if not binary.exists():
            _compile(binary)
    return binary


@cache
def _digest() -> str:
    versions = _pkg_config("--modversion")
    digest = hashlib.sha256(" ".join([*FLAGS, *PACKAGES, *versions]).encode())
    for source in sorted(NODES.glob("*.[ch]pp")):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def _compile(binary: Path) -> None:
    """Compiles all sources at the same time, then links."""
    flags = [*FLAGS, *_pkg_config("--cflags")]
    parts = {
        source: binary.with_suffix(f".{os.getpid()}.{source.stem}.o")
        for source in NODES.glob("*.cpp")
    }
    compilers = [
        subprocess.Popen(["g++", *flags, "-c", str(source), "-o", str(object_file)])
        for source, object_file in parts.items()
    ]
    codes = [compiler.wait() for compiler in compilers]
    if any(codes):
        raise RuntimeError("the C++ test nodes do not compile: see above")
    unfinished = binary.with_suffix(f".{os.getpid()}")
    objects = [str(object_file) for object_file in parts.values()]
    subprocess.run(["g++", *objects, "-o", str(unfinished), *_pkg_config("--libs")], check=True)
    for object_file in parts.values():
        object_file.unlink()
    unfinished.rename(binary)


def _pkg_config(option: str) -> list[str]:
    command = ["pkg-config", option, *PACKAGES]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(done.stderr.strip())
    return done.stdout.split()


if __name__ == "__main__":
    compiled_node()
