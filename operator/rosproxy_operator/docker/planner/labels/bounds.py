"""What labels may ask for: the administrator's word, which they can only narrow.

Whoever starts a container chooses its image, and often does not know what labels that carries. A
label can have ports of the host published, a capability given to a proxy, a name taken on a
network (the master's host name leads to the proxy there), and announcements sent to other hosts.
The operator's options say how far.

A master that is not allowed leaves the container out. Of anything else that goes too far, the
container gets what is allowed, and a warning.
"""

import re
from dataclasses import replace
from fnmatch import fnmatchcase
from typing import get_args

from rosproxy.net.addresses import HostPort
from rosproxy.ros1.protocol.uris import parse_slave_uri
from rosproxy.settings import DataPlane, read_peer
from rosproxy_operator.docker.planner.model import Member, PlanSettings

LEAST_PORT = 1024
"""Where no master is named, the least port of one that a label may name.

rosmaster is started by people who are not root, at 11311 as a rule, and can have none below. There
are the web and mail servers in whose place a proxy must not stand.
"""
_PATTERN = re.compile(
    r"(?:http://)?(?P<host>[a-z0-9_.*?-]+|\[[0-9a-f:.*?]+\])(?::(?P<port>[0-9*?]{1,5}))?/?"
)


def read_host_pattern(text: str) -> str:
    """Which masters or peers are meant, ``host:port`` in lower case; * and ? stand for others.

    What a master's URI is led by may stand before it. Raises ValueError.
    """
    found = _PATTERN.fullmatch(text.strip().lower())
    if found is None:
        raise ValueError(
            f"{text[:40]!r} is not of the form HOST or HOST:PORT, such as robot*:11311"
        )
    return f"{found['host']}:{found['port'] or '*'}"


def refused_master(uri: str, settings: PlanSettings) -> str:
    """Why a container may not have a master, given as a URI; empty if it may."""
    where = parse_slave_uri(uri)
    option = parse_slave_uri((settings.master_uri or "").lower())
    if where is None or where == option or _is_allowed_master(where, settings.allow_master):
        return ""
    names = ", ".join(settings.allow_master)
    usual = f"names a port below {LEAST_PORT}, where no ROS master is"
    why = f"is none of the operator's --allow-master ({names})" if names else usual
    return f"{why}: if it is one, start the operator with --allow-master {where}"


def allowed_planes(settings: PlanSettings) -> frozenset[DataPlane]:
    """The data planes that labels may ask for."""
    every: tuple[DataPlane, ...] = get_args(DataPlane)
    usual = tuple(plane for plane in every if plane != "kernel")
    return frozenset({*(settings.allow_data_plane or usual), settings.data_plane})


def narrowed(asked: Member, settings: PlanSettings) -> tuple[Member, tuple[str, ...]]:
    """What a container gets of what its labels ask for, and what it is told of the rest."""
    told: list[str] = []
    most = max(settings.max_ports, settings.ports)
    if asked.ports > most:
        told.append(
            f"label rosproxy.ports={asked.ports} asks for more than labels may: its proxy gets "
            f"{most}; start the operator with --max-ports {asked.ports} if it is to have them"
        )
        asked = replace(asked, ports=most)
    if asked.data_plane and asked.data_plane not in allowed_planes(settings):
        told.append(
            f"label rosproxy.data-plane={asked.data_plane} asks for what labels may not: its proxy "
            f"is as without it; start the operator with --allow-data-plane {asked.data_plane} if "
            "it is to have that"
        )
        asked = replace(asked, data_plane=None)
    if asked.slave_control == "any" and settings.slave_control == "master":
        told.append(
            "label rosproxy.slave-control=any is ignored: the operator's --slave-control is "
            "master, which labels can't widen"
        )
        asked = replace(asked, slave_control=None)
    if asked.redirect and not settings.redirect:
        told.append(
            "label rosproxy.redirect=true is ignored: the operator's --no-redirect says otherwise, "
            "which labels can't widen"
        )
    if refused := {peer for peer in asked.peers if not _is_allowed_peer(peer, settings)}:
        told.append(
            f"label rosproxy.peers names {', '.join(sorted(refused))}, which labels may not: it is "
            "not told of participants; start the operator with "
            f"{' '.join(f'--allow-peer {peer}' for peer in sorted(refused))} if it is to be"
        )
        asked = replace(asked, peers=asked.peers - refused)
    return asked, tuple(told)


def _is_allowed_master(where: HostPort, patterns: tuple[str, ...]) -> bool:
    return _matches(where, patterns) if patterns else where.port >= LEAST_PORT


def _is_allowed_peer(peer: str, settings: PlanSettings) -> bool:
    own = not settings.allow_peer or peer in settings.ros2_peer
    return own or _matches(read_peer(peer), settings.allow_peer)


def _matches(where: HostPort, patterns: tuple[str, ...]) -> bool:
    ends = (pattern.rpartition(":")[::2] for pattern in patterns)
    return any(
        fnmatchcase(where.host.lower(), host.strip("[]")) and fnmatchcase(str(where.port), port)
        for host, port in ends
    )
