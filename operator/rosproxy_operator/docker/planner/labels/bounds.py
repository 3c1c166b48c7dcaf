"""Keep labels within the bounds of the administrator. A label can only narrow these bounds.

A user that starts a container chooses an image, and often does not know the labels of the image. A
label can publish ports of the host, and give a capability to a proxy. A label can take a name on a
network: the host name of the master leads to the proxy there. A label can also send announcements
to other hosts. The options of the operator set the bounds.

A container with a master that is not allowed gets no proxy. For all other labels, the container
gets the part that is allowed, and a warning.
"""

from dataclasses import replace
from fnmatch import fnmatchcase

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.setting_kinds import DataPlane, read_peer, read_site_link
from rosproxy.shared.uris import parse_slave_uri
from rosproxy_operator.common.problem import Fault
from rosproxy_operator.docker.planner.model import Member
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.spec import WISHES

LEAST_MASTER_PORT = 1024
"""The least port of a master in a label, if the operator has no --allow-master.

Users start rosmaster without root, usually at 11311, so a master has no port below 1024. Web and
mail servers have such ports, and a proxy must not take the place of these servers.
"""


def refused_master(uri: str, settings: PlanSettings) -> Fault | None:
    """Return why a container may not have the master at ``uri``; None for an allowed master.

    Also None for a text that is no URI of a master.
    """
    master = parse_slave_uri(uri)
    option = parse_slave_uri((settings.master_uri or "").lower())
    if master is None or master == option or _is_allowed_master(master, settings.allow_master):
        return None
    names = ", ".join(settings.allow_master)
    usual = f"has a port below {LEAST_MASTER_PORT}, which is not allowed for a master by default"
    reason = f"matches no --allow-master of the operator ({names})" if names else usual
    fix = f"To allow this master, start the operator with --allow-master {master}"
    return Fault(reason, fix)


def allowed_planes(settings: PlanSettings) -> frozenset[DataPlane]:
    """Return the data planes that labels may ask for."""
    free = WISHES["data_plane"].free
    return frozenset({*(settings.allow_data_plane or free), settings.data_plane})


def narrowed(request: Member, settings: PlanSettings) -> tuple[Member, tuple[Fault, ...]]:
    """Return the allowed part of a container's request, and warnings about the refused part."""
    warnings: list[Fault] = []
    limit = max(settings.max_ports, settings.ports)
    if request.ports > limit:
        text = f"label rosproxy.ports={request.ports} exceeds the bound of labels: the proxy gets "
        fix = f"To allow more, start the operator with --max-ports {request.ports}"
        warnings.append(Fault(f"{text}{limit} ports", fix))
        request = replace(request, ports=limit)
    wishes = dict(request.wishes)
    plane = wishes.get("data_plane", settings.data_plane)
    allowed = allowed_planes(settings)
    if plane not in allowed:
        text = f"label rosproxy.data-plane={plane} is ignored: the operator does not allow this "
        options = " ".join(f"--allow-data-plane {p}" for p in (plane, *sorted(allowed)))
        fix = f"To allow this value, start the operator with {options}"
        warnings.append(Fault(f"{text}value in labels", fix))
        del wishes["data_plane"]
    if wishes.get("slave_control") == "any" and settings.slave_control == "master":
        text = (
            "label rosproxy.slave-control=any is ignored: the operator has --slave-control master, "
            "and a label can only narrow this option"
        )
        warnings.append(Fault(text, "Remove the label"))
        del wishes["slave_control"]
    if request.redirect and not settings.redirect:
        text = (
            "label rosproxy.redirect=true is ignored: the operator has --no-redirect, and a label "
            "can't override this option"
        )
        warnings.append(Fault(text, "Remove the label"))
    if refused := {peer for peer in request.peers if not _is_allowed_peer(peer, settings)}:
        text = (
            f"label rosproxy.peers names {', '.join(sorted(refused))}, which the operator does not "
            "allow in labels. The proxy announces no participants there"
        )
        allowing = " ".join(f"--allow-peer {peer}" for peer in sorted(refused))
        fix = f"To allow these peers, start the operator with {allowing}"
        warnings.append(Fault(text, fix))
        request = replace(request, peers=request.peers - refused)
    return replace(request, wishes=wishes), tuple(warnings)


def _is_allowed_master(master: HostPort, patterns: tuple[str, ...]) -> bool:
    return _matches(master, patterns) if patterns else master.port >= LEAST_MASTER_PORT


def _is_allowed_peer(peer: str, settings: PlanSettings) -> bool:
    is_unrestricted = not settings.allow_peer or peer in settings.ros2_peer
    return is_unrestricted or _matches(read_peer(peer), settings.allow_peer)


def is_allowed_router(router: HostPort, settings: PlanSettings) -> bool:
    """Return whether the proxy for rmw_zenoh may connect to a router outside."""
    return not settings.allow_peer or _matches(router, settings.allow_peer)


def is_allowed_link(link: str, settings: PlanSettings) -> bool:
    """Return whether the label of a container may ask for a link to another site."""
    site = read_site_link(link)
    patterns = (pattern.partition("/") for pattern in settings.allow_link)
    allowed = tuple(pattern for protocol, _, pattern in patterns if protocol == site.protocol)
    return link in settings.zenoh_link or _matches(site.peer, allowed)


def _matches(target: HostPort, patterns: tuple[str, ...]) -> bool:
    pairs = (pattern.rpartition(":")[::2] for pattern in patterns)
    return any(
        # Brackets around an IPv6 address would be a set of characters to fnmatch.
        fnmatchcase(target.host.lower(), host.strip("[]")) and fnmatchcase(str(target.port), port)
        for host, port in pairs
    )
