"""Finds the Docker operators of this machine by their signs (`rosproxy.shared.machine.signs`).

So a command also finds an operator that listens at another address than --admin-bind. Any program
can publish a sign, so a command follows signs to loopback alone, where only programs of this
machine listen.
"""

import hashlib
import socket

from rosproxy.shared.addresses import HostPort, is_loopback, parse_host_port
from rosproxy.shared.machine import signs

MOST_ENDPOINTS_ASKED = 4
"""The highest number of endpoints that a command asks."""


def publish_sign(admin: HostPort, engine: str) -> socket.socket | None:
    """Publish the sign of an operator that listens at ``admin``, until the socket is closed.

    ``engine`` is the URL of the operator's engine. None if the kernel refuses the socket.
    """
    return signs.publish(f"{_prefix(engine)}/{admin}")


def operators(first: HostPort, engine: str) -> list[HostPort]:
    """Return endpoints at which operators of this engine may listen, MOST_ENDPOINTS_ASKED at most.

    ``first`` comes first, then the endpoints of the signs on loopback or a wildcard address.
    """
    matches = signs.read_all(_prefix(engine) + r"/([0-9a-f.:\[\]]{1,60})")
    listeners = (parse_host_port(match[1]) for match in matches)
    near = (at for at in listeners if at and (is_loopback(at.host) or at.host in ("0.0.0.0", "::")))
    return list(dict.fromkeys([first, *near]))[:MOST_ENDPOINTS_ASKED]


def _prefix(engine: str) -> str:
    """Return the beginning of the signs for an engine: a machine may have several engines."""
    return f"rosproxy-operator/docker/{hashlib.sha256(engine.encode()).hexdigest()[:16]}"
