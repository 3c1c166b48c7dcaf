"""Signs: what a process says of itself to all others on this machine.

A sign is a Unix socket with an abstract name (unix(7)). Like ports it belongs to a network
namespace, and the kernel takes it down when its process ends, however that ends. ``/proc/net/unix``
lists all of them.

Anybody can put up a sign. So what is read is told to people, or tried, and proves nothing.
"""

import contextlib
import re
import secrets
import socket
from pathlib import Path

_LISTED = Path("/proc/net/unix")


def put_up(text: str) -> socket.socket | None:
    """Put up a sign, without blanks; it stays until the socket is closed.

    Others may have the same text. None where that is not possible: a sign only helps.
    """
    with contextlib.suppress(OSError):
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            sock.bind(f"\0{text}/{secrets.token_hex(4)}")
        except OSError:
            sock.close()
            raise
        return sock
    return None


def read_all(text: str) -> list[re.Match[str]]:
    """The signs in this network namespace whose text is like this regular expression."""
    try:
        lines = _LISTED.read_text("utf-8", "replace").splitlines()
    except OSError:
        return []
    pattern = re.compile(rf" @{text}/\w{{8}}$")
    return [match for line in lines if (match := pattern.search(line))]
