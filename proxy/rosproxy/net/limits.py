"""What the system allows this process."""

import contextlib
import resource

SPARE_FILES = 64
"""Open files that the proxy needs besides its ports and connections."""


def raise_file_limit() -> None:
    """Have as many open files as the system lets this process have at most (``ulimit -Hn``).

    Each relayed connection takes up to six: two sockets and two pipes.
    """
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def files_for(ports: int) -> bool:
    """Whether there may be enough open files to bind so many ports."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return soft == resource.RLIM_INFINITY or soft >= ports + SPARE_FILES
