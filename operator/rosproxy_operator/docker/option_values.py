"""Kinds of values of the Docker operator's options. See `rosproxy.shared.setting_kinds`."""

import re
from pathlib import Path

from rosproxy.shared.addresses import is_loopback
from rosproxy.shared.setting_kinds import (
    LINK_PROTOCOLS,
    Number,
    Text,
    read_address,
    read_master_uri,
)
from rosproxy.shared.uris import parse_slave_uri
from rosproxy_operator.common.ros2 import read_peer_name
from rosproxy_operator.common.zenoh import read_link_name

MOST_PORTS = 1000
"""Most ports of a proxy. For each port, the engine needs rules and, by default, a process."""
NOWHERE = "none"
"""The value of ``--ros2-lan`` for no LAN."""
LEAST_MEMORY_BYTES = 64 * 1024**2
MOST_MEMORY_BYTES = 1024**4
"""Least and most bytes of a memory bound. An idle proxy takes 32 MiB."""
LEAST_PIDS = 256
"""Threads and processes that a proxy needs for a hundred connections."""
LEAST_SECRET_CHARACTERS = 32
"""Least characters of a secret in a file."""
MOST_PATH_CHARACTERS = 4096
"""Characters of a path at most (PATH_MAX)."""
_MEMORY = re.compile(r"([0-9]{1,15})([bkmg]?)b?")
_UNITS = {"": 1, "b": 1, "k": 1024, "m": 1024**2, "g": 1024**3}
_NETWORK = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")
_HOST_PORT_PATTERN = re.compile(
    r"(?:http://)?(?P<host>[a-z0-9_.*?-]+|\[[0-9a-f:.*?]+\])(?::(?P<port>[0-9*?]{1,5}))?/?"
)
_NAME_PATTERN = re.compile(r"[a-z0-9_.*?-]{1,253}")


def read_host_pattern(text: str) -> str:
    """Return a pattern of masters or peers as ``host:port`` in lower case. Raises ValueError.

    ``*`` and ``?`` are wildcards. A text without a port gets the port ``*``. The text may begin
    with ``http://``, like a master's URI.
    """
    match = _HOST_PORT_PATTERN.fullmatch(text.strip().lower())
    if match is None:
        raise ValueError(
            f"{text[:40]!r} is not of the form HOST or HOST:PORT, such as robot*:11311"
        )
    return f"{match['host']}:{match['port'] or '*'}"


def read_link_pattern(text: str) -> str:
    """Return a pattern of links as ``tls/host:port`` in lower case. Raises ValueError."""
    protocol, _, host = text.strip().lower().partition("/")
    try:
        if protocol in LINK_PROTOCOLS:
            return f"{protocol}/{read_host_pattern(host)}"
    except ValueError:
        pass  # the message below has an example for links
    example = "tls/HOST or tls/HOST:PORT, such as tls/*.example:7447"
    raise ValueError(f"{text[:40]!r} is not of the form {example}")


def read_host_directory(text: str) -> str:
    """Return the path of a directory of the Docker host. Raises ValueError.

    The directory need not exist here: the operator may run in a container.
    """
    if text and (not text.startswith("/") or len(text) > MOST_PATH_CHARACTERS):
        raise ValueError(f"{text[:40]!r} is not a full path, such as /etc/rosproxy/link")
    return text


def read_name_pattern(text: str) -> str:
    """Return a pattern of host names in lower case, with wildcards * and ?. Raises ValueError."""
    pattern = text.strip().lower()
    if not _NAME_PATTERN.fullmatch(pattern):
        raise ValueError(f"{text[:40]!r} is not a host name such as robot or *.lab.example")
    return pattern


def read_shared_master_uri(text: str) -> str:
    """Check and return the URI of a master that is not on loopback; empty for an empty text.

    Raises ValueError.
    """
    master = parse_slave_uri(read_master_uri(text)) if text else None
    if master and is_loopback(master.host):
        raise ValueError(
            f"{text!r} is a loopback address: for a container, that is the container itself. Give "
            "the name or address of the master's host, or http://host.docker.internal:PORT for a "
            "master on this host"
        )
    return text


def read_lan(text: str) -> str:
    """Return an IPv4 address; NOWHERE and an empty text stay as they are. Raises ValueError."""
    if text in ("", NOWHERE):
        return text
    address = read_address(text)
    if address is None or ":" in address:
        raise ValueError(
            f"{text[:40]!r} is neither an IPv4 address such as 192.0.2.10 nor {NOWHERE}"
        )
    return address


def read_memory(text: str) -> int:
    """Return the bytes of a size such as 512m or 1g; 0 stands for no bound. Raises ValueError."""
    match = _MEMORY.fullmatch(text.strip().lower())
    size = int(match[1]) * _UNITS[match[2]] if match else -1
    if size and not LEAST_MEMORY_BYTES <= size <= MOST_MEMORY_BYTES:
        raise ValueError(
            f"{text[:40]!r} is neither a size from 64m to 1024g, such as 1g, nor 0 for no bound"
        )
    return size


def read_pids(text: str) -> int:
    """Return a number of threads and processes; 0 stands for no bound. Raises ValueError."""
    digits = text.strip()
    count = int(digits) if re.fullmatch(r"[0-9]{1,7}", digits, re.ASCII) else -1
    if count and count < LEAST_PIDS:
        raise ValueError(
            f"{text[:40]!r} is neither a number from {LEAST_PIDS} on nor 0 for no bound"
        )
    return count


def read_secret(path: str) -> str:
    """Return the secret in the file at ``path``, stripped; empty for an empty path.

    Raises ValueError for an unreadable file, and for fewer than LEAST_SECRET_CHARACTERS characters.
    """
    if not path:
        return ""
    try:
        secret = Path(path).read_text("utf-8").strip()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "not UTF-8"
        raise ValueError(f"{path} can't be read: {reason}") from None
    if len(secret) < LEAST_SECRET_CHARACTERS:
        raise ValueError(
            f"{path} has fewer than {LEAST_SECRET_CHARACTERS} characters. openssl rand -hex 32 "
            "prints a new secret"
        )
    return secret


def read_uplink(text: str) -> str:
    """Return the name of a Docker network. Raises ValueError."""
    if not _NETWORK.fullmatch(text):
        raise ValueError(f"{text!r} can't be the name of a Docker network")
    return text


PORTS = Number("N", 1, MOST_PORTS)
SHARED_MASTER_URI = Text("URI", read_shared_master_uri)
HOST_PATTERN = Text("HOST[:PORT]", read_host_pattern)
NAME_PATTERN = Text("HOST", read_name_pattern)
LINK_NAME = Text("tls/HOST[:PORT]", read_link_name)
LINK_PATTERN = Text("tls/HOST[:PORT]", read_link_pattern)
HOST_DIRECTORY = Text("DIR", read_host_directory)
PEER_NAME = Text("HOST[:PORT]", read_peer_name)
LAN = Text("ADDRESS|none", read_lan)
MEMORY = Text("SIZE", read_memory)
PIDS = Text("N", read_pids)
SECRET = Text("FILE", read_secret)
NETWORK = Text("NETWORK", read_uplink)
