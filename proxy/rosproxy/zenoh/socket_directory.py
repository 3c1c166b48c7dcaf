"""A directory for the sockets by which the hub reaches the routers of containers."""

import contextlib
import shutil
import tempfile
from pathlib import Path

PARENTS = ("/dev/shm", "/run", "/tmp")  # noqa: S108 - mkdtemp makes a private directory
"""Parents of the directory; the first that is writable is used. With a read-only file system,
containers can write to /dev/shm."""
_MOUNT = (
    f"need a directory for sockets, and none of {', '.join(PARENTS)} is writable. "
    "Mount a tmpfs at /dev/shm"
)
NO_DIRECTORY = f"rules on rmw_zenoh {_MOUNT}"
LINKS_NEED_DIRECTORY = f"links to other sites {_MOUNT}"


def make_socket_directory() -> str:
    """Make a directory that only this user can enter; empty if no parent is writable."""
    for parent in PARENTS:
        with contextlib.suppress(OSError):
            return tempfile.mkdtemp(prefix="rosproxy-zenoh-", dir=parent)
    return ""


def remove_socket_directory(path: str) -> None:
    """Remove a directory of `make_socket_directory`, with the sockets in it. Ignore other paths."""
    if path and Path(path).name.startswith("rosproxy-zenoh-"):
        shutil.rmtree(path, ignore_errors=True)
