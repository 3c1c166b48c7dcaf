"""The cgroups below which the pods of a node run."""

import os
import time
from pathlib import Path

from tests.kubernetes.cluster.programs import kill

_ROOT = Path("/sys/fs/cgroup")


def make(name: str) -> None:
    """Make a cgroup with this name in each hierarchy, or in the only hierarchy of version 2."""
    for hierarchy in _hierarchies():
        path = hierarchy / name
        path.mkdir(exist_ok=True)
        # In version 1, a new cpuset has no processors.
        for file in ("cpuset.cpus", "cpuset.mems"):
            if (path / file).exists() and not _version_2():
                (path / file).write_text((hierarchy / file).read_text())


def empty(name: str) -> None:
    """Kill every process in a cgroup, also processes that start meanwhile."""
    while pids := _pids(name):
        kill(pids)


def remove(name: str) -> None:
    """Remove a cgroup with all cgroups below."""
    empty(name)
    for hierarchy in _hierarchies():
        for directory, _, _ in os.walk(hierarchy / name, topdown=False):
            _remove(Path(directory))


def _remove(directory: Path, seconds: float = 5) -> None:
    """Remove a cgroup, which is still busy for a moment after its last process."""
    end = time.monotonic() + seconds
    while True:
        try:
            return directory.rmdir()
        except OSError:
            if time.monotonic() > end:
                raise
            time.sleep(0.05)


def _pids(name: str) -> list[int]:
    pids = set()
    for hierarchy in _hierarchies():
        for directory, _, files in os.walk(hierarchy / name):
            if "cgroup.procs" in files:
                pids |= set(map(int, Path(directory, "cgroup.procs").read_text().split()))
    return sorted(pids)


def _hierarchies() -> list[Path]:
    if _version_2():
        return [_ROOT]
    real = {path.resolve() for path in _ROOT.iterdir()}
    return sorted(path for path in real if (path / "cgroup.procs").exists())


def _version_2() -> bool:
    return (_ROOT / "cgroup.controllers").exists()
