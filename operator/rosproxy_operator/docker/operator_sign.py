"""Where operators for Docker listen on this machine: each puts up a sign (`rosproxy.net.signs`).

So commands find one that was given another ``--admin-bind``. Whoever a sign names is asked, as
whoever listens at the default is: on loopback, where only this machine's programs listen.
"""

import hashlib
import socket

from rosproxy.net import signs
from rosproxy.net.addresses import HostPort, is_loopback, parse_host_port

MOST = 4
"""Operators that are asked."""


def publish_sign(admin: HostPort, engine: str) -> socket.socket | None:
    """Put up the sign of an operator that listens there; it stays until the socket is closed.

    ``engine`` is the URL of the engine that it looks after.
    """
    return signs.put_up(f"{_begin(engine)}/{admin}")


def operators(first: HostPort, engine: str) -> list[HostPort]:
    """Where operators of this engine may listen: ``first``, then where signs say; MOST at most."""
    matches = signs.read_all(_begin(engine) + r"/([0-9a-f.:\[\]]{1,60})")
    listeners = (parse_host_port(match[1]) for match in matches)
    near = (at for at in listeners if at and (is_loopback(at.host) or at.host in ("0.0.0.0", "::")))
    return list(dict.fromkeys([first, *near]))[:MOST]


def _begin(engine: str) -> str:
    """How signs begin: a machine may have several engines, with an operator each."""
    return f"rosproxy-operator/docker/{hashlib.sha256(engine.encode()).hexdigest()[:16]}"
