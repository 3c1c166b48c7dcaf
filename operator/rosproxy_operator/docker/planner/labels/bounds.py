"""What labels may ask for: the administrator's bounds, which they can only narrow.

Whoever starts a container chooses its image, and often does not know what labels that carries. A
label can have ports of the host published, a capability given to a proxy, a name taken on a
network (the master's host name leads to the proxy there), and announcements sent to other hosts.
The operator's options say how far.

A master that is not allowed leaves the container out. Of anything else that goes too far, the
container gets what is allowed, and a warning.
"""

from dataclasses import replace
from fnmatch import fnmatchcase

from rosproxy.net.addresses import HostPort
from rosproxy.ros1.protocol.uris import parse_slave_uri
from rosproxy.setting_kinds import DataPlane, read_peer
from rosproxy_operator.docker.planner.model import Member
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.spec import WISHES

LEAST_PORT = 1024
"""Where no master is named, the least port of one that a label may name.

rosmaster is started by people who are not root, at 11311 as a rule, and can have none below. There
are the web and mail servers in whose place a proxy must not stand.
"""


def refused_master(uri: str, settings: PlanSettings) -> str:
    """Why a container may not have a master, given as a URI; empty if it may."""
    master = parse_slave_uri(uri)
    option = parse_slave_uri((settings.master_uri or "").lower())
    if master is None or master == option or _is_allowed_master(master, settings.allow_master):
        return ""
    names = ", ".join(settings.allow_master)
    usual = f"has a port below {LEAST_PORT}, which is not allowed for a master by default"
    reason = f"matches no --allow-master of the operator ({names})" if names else usual
    return f"{reason}. To allow this master, start the operator with --allow-master {master}"


def allowed_planes(settings: PlanSettings) -> frozenset[DataPlane]:
    """The data planes that labels may ask for."""
    free = WISHES["data_plane"].free
    return frozenset({*(settings.allow_data_plane or free), settings.data_plane})


def narrowed(request: Member, settings: PlanSettings) -> tuple[Member, tuple[str, ...]]:
    """What a container gets of what its labels ask for, and the warnings about the rest."""
    warnings: list[str] = []
    limit = max(settings.max_ports, settings.ports)
    if request.ports > limit:
        warnings.append(
            f"label rosproxy.ports={request.ports} exceeds the bound of labels: the proxy gets "
            f"{limit} ports. To allow more, start the operator with --max-ports {request.ports}"
        )
        request = replace(request, ports=limit)
    wishes = dict(request.wishes)
    plane = wishes.get("data_plane", settings.data_plane)
    if plane not in allowed_planes(settings):
        warnings.append(
            f"label rosproxy.data-plane={plane} is ignored: the operator does not allow this value "
            f"in labels. To allow it, start the operator with --allow-data-plane {plane}"
        )
        del wishes["data_plane"]
    if wishes.get("slave_control") == "any" and settings.slave_control == "master":
        warnings.append(
            "label rosproxy.slave-control=any is ignored: the operator has --slave-control master, "
            "and a label can only narrow this option"
        )
        del wishes["slave_control"]
    if request.redirect and not settings.redirect:
        warnings.append(
            "label rosproxy.redirect=true is ignored: the operator has --no-redirect, and a label "
            "can't override this option"
        )
    if refused := {peer for peer in request.peers if not _is_allowed_peer(peer, settings)}:
        warnings.append(
            f"label rosproxy.peers names {', '.join(sorted(refused))}, which the operator does not "
            "allow in labels. The proxy announces no participants there. To allow it, start the "
            f"operator with {' '.join(f'--allow-peer {peer}' for peer in sorted(refused))}"
        )
        request = replace(request, peers=request.peers - refused)
    return replace(request, wishes=wishes), tuple(warnings)


def _is_allowed_master(master: HostPort, patterns: tuple[str, ...]) -> bool:
    return _matches(master, patterns) if patterns else master.port >= LEAST_PORT


def _is_allowed_peer(peer: str, settings: PlanSettings) -> bool:
    is_unrestricted = not settings.allow_peer or peer in settings.ros2_peer
    return is_unrestricted or _matches(read_peer(peer), settings.allow_peer)


def is_allowed_router(router: HostPort, settings: PlanSettings) -> bool:
    """Whether the proxy for rmw_zenoh may connect to a router outside."""
    return not settings.allow_peer or _matches(router, settings.allow_peer)


def _matches(target: HostPort, patterns: tuple[str, ...]) -> bool:
    pairs = (pattern.rpartition(":")[::2] for pattern in patterns)
    return any(
        # Brackets around an IPv6 address would be a set of characters to fnmatch.
        fnmatchcase(target.host.lower(), host.strip("[]")) and fnmatchcase(str(target.port), port)
        for host, port in pairs
    )
