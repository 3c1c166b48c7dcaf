"""The settings of ``rosproxy-operator docker``: plain data, checked.

``read_…`` makes one value of a text and raises ValueError; see `rosproxy.settings`.
"""

import re
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from rosproxy.net.addresses import HostPort, is_loopback
from rosproxy.ros1.protocol.uris import parse_slave_uri
from rosproxy.values import SettingError, read_address, read_master_uri
from rosproxy_operator.common.policy import administrators_policy
from rosproxy_operator.common.proxy_bounds import make_proxy_bounds
from rosproxy_operator.docker.planner.model import NOWHERE, PlanSettings

DEFAULT_ADMIN = HostPort("127.0.0.1", 11313)
LEAST_MEMORY, MOST_MEMORY = 64 * 1024**2, 1024**4
"""Bytes that a proxy may be bounded to: one that does nothing has 32 MiB."""
LEAST_PIDS = 256
"""Threads that a proxy needs for a hundred connections."""
LEAST_SECRET = 32
_MEMORY = re.compile(r"([0-9]{1,15})([bkmg]?)b?")
_UNITS = {"": 1, "b": 1, "k": 1024, "m": 1024**2, "g": 1024**3}
_NETWORK = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")


def make_plan_settings(options: Mapping[str, Any]) -> PlanSettings:
    """Settings from the values of the command line's options, by their names.

    Raises SettingError if they don't go together.
    """
    policy = administrators_policy(options["policy"], options["policy_mode"])
    values = {**options, "policy": policy, "proxy_bounds": make_proxy_bounds(options)}
    settings = PlanSettings(**{field.name: values[field.name] for field in fields(PlanSettings)})
    window, ports = settings.port_window, settings.ports
    if len(window) < ports:
        raise SettingError("--port-window", f"{window} has {len(window)} ports, --ports is {ports}")
    return settings


def read_shared_master_uri(text: str) -> str:
    """The URI of a master as all containers can use it; empty for no text. Raises ValueError."""
    master = parse_slave_uri(read_master_uri(text)) if text else None
    if master and is_loopback(master.host):
        raise ValueError(
            f"{text!r} means another machine to each container; give the address or name of the "
            "master's host, or http://host.docker.internal:PORT for this one"
        )
    return text


def read_lan(text: str) -> str:
    """An IPv4 address of this host on the LAN, or the word for none. Raises ValueError."""
    if text in ("", NOWHERE):
        return text
    address = read_address(text)
    if address is None or ":" in address:
        raise ValueError(f"{text[:40]!r} is not an IPv4 address such as 192.0.2.10, or {NOWHERE}")
    return address


def read_memory(text: str) -> int:
    """Bytes, as ``docker run --memory`` has them: 512m, 1g; 0 for no bound. Raises ValueError."""
    match = _MEMORY.fullmatch(text.strip().lower())
    size = int(match[1]) * _UNITS[match[2]] if match else -1
    if size and not LEAST_MEMORY <= size <= MOST_MEMORY:
        raise ValueError(f"{text[:40]!r} is not a size from 64m on, such as 1g; or 0 for no bound")
    return size


def read_pids(text: str) -> int:
    """How many threads and processes; 0 for no bound. Raises ValueError."""
    digits = text.strip()
    count = int(digits) if re.fullmatch(r"[0-9]{1,7}", digits, re.ASCII) else -1
    if count and count < LEAST_PIDS:
        raise ValueError(f"{text[:40]!r} is not a number from {LEAST_PIDS} on, or 0 for no bound")
    return count


def read_secret(path: str) -> str:
    """The secret in a file, without blanks around it; empty for no path. Raises ValueError."""
    if not path:
        return ""
    try:
        secret = Path(path).read_text("utf-8").strip()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "it is not UTF-8"
        raise ValueError(f"{path} can't be read: {reason}") from None
    if len(secret) < LEAST_SECRET:
        raise ValueError(
            f"{path} must hold at least {LEAST_SECRET} characters: openssl rand -hex 32 gives them"
        )
    return secret


def read_uplink(text: str) -> str:
    """The name of a network. Raises ValueError."""
    if not _NETWORK.fullmatch(text):
        raise ValueError(f"{text!r} is not a network's name")
    return text
