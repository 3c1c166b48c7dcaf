"""Signs: short texts that a process publishes to all processes on this machine.

A sign is a Unix socket with an abstract name (unix(7)). Like a port, a sign belongs to a network
namespace, and the kernel removes the sign with the process. ``/proc/net/unix`` lists all signs.

Any process can publish any sign, so signs prove nothing. Use signs only in messages, or verify by
other means what the text says.
"""

import contextlib
import re
import secrets
import socket
from pathlib import Path

_SOCKET_LIST = Path("/proc/net/unix")


def publish(text: str) -> socket.socket | None:
    """Publish a sign, a text without blanks, until the returned socket is closed.

    Several processes may publish the same text. None if the kernel refuses the socket.
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


def read_all(sign_pattern: str) -> list[re.Match[str]]:
    """The matches of a regular expression with the signs in this network namespace.

    ``sign_pattern`` describes the whole text of a sign. Other signs are left out.
    """
    try:
        lines = _SOCKET_LIST.read_text("utf-8", "replace").splitlines()
    except OSError:
        return []
    pattern = re.compile(rf" @{sign_pattern}/\w{{8}}$")
    return [match for line in lines if (match := pattern.search(line))]
