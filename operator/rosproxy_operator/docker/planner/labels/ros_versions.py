"""Read the ROS versions of a container, and what the container asks of a proxy for DDS.

The first source that states the version counts:

1. The label ``rosproxy.ros``.
2. The variables ROS_VERSION and ROS_DISTRO, which most images with ROS have.
3. The label ``rosproxy.master-uri`` or the variable ROS_MASTER_URI: ROS 1.
4. A label or non-empty variable that only ROS 2 has, such as ROS_DOMAIN_ID, or a command that runs
   a router of zenoh: ROS 2.

Without such a source, the operator assumes ROS 1. The label ``rosproxy.rmw`` or the variable
RMW_IMPLEMENTATION states that the ROS 2 nodes use rmw_zenoh instead of DDS. Without both, a command
that runs a router of zenoh states that.
"""

import re
from collections.abc import Collection, Iterator

from rosproxy.shared.addresses import is_inside, is_loopback
from rosproxy.shared.domain_ports import LAST_DOMAIN
from rosproxy_operator.common.problem import Fault
from rosproxy_operator.common.ros2 import (
    MOST_PEERS,
    ROS1_DISTROS,
    is_dds,
)
from rosproxy_operator.common.ros2_variables import ROS2_VARIABLES
from rosproxy_operator.docker.planner.labels.readers import (
    ADVERTISE_HOST,
    ALIAS,
    DOMAIN,
    LINK,
    MASTER_URI,
    PEERS,
    PORTS,
    REDIRECT,
    RMW,
    ROS,
    UnusableLabel,
    named,
    quoted,
)
from rosproxy_operator.docker.planner.model import Container, HostState
from rosproxy_operator.proxy_spec.spec import WISHES

_ROS1_LABELS = (MASTER_URI, REDIRECT, *(w.label for w in WISHES.values() if w.ros == ("1",)))
_ROS2_LABELS = (RMW, DOMAIN, PEERS)
_NOT_DDS_LABELS = (LINK,)
_NOT_ZENOH_LABELS = (
    *(DOMAIN, PORTS, ADVERTISE_HOST, MASTER_URI),
    *(wish.label for wish in WISHES.values() if "zenoh" not in wish.ros),
)
_OF_ZENOH = Fault(
    "the label is for rmw_zenoh, the container is not",
    "Remove the label, or set RMW_IMPLEMENTATION=rmw_zenoh_cpp in the container (or the label "
    f"{RMW}=zenoh)",
)
UNKNOWN_VERSION = "no label and no variable states the ROS version"


def versions(container: Container) -> frozenset[str]:
    """Return the ROS versions of a container: ``1``, ``2`` or ``zenoh``, or ``1`` and another.

    ``zenoh`` stands for ROS 2 with rmw_zenoh. Raises UnusableLabel.
    """
    of_ros = _ros_versions(container)
    if "2" in of_ros and _has_zenoh(container):
        return of_ros - {"2"} | {"zenoh"}
    return of_ros


def _has_zenoh(container: Container) -> bool:
    """Whether the ROS 2 nodes in a container use rmw_zenoh. Raises UnusableLabel."""
    labels = container.labels
    if RMW in labels and labels[RMW].strip().lower() != "zenoh":
        fix = f"Write {RMW}=zenoh, or remove the label: the proxy then serves DDS"
        raise UnusableLabel(f"{named(RMW, labels)} is not zenoh", fix)
    # rmw_zenohd itself does not need the variable.
    stated = container.variables.get("RMW_IMPLEMENTATION", "")
    return RMW in labels or (not is_dds(stated) if stated else container.is_zenoh_router)


def _ros_versions(container: Container) -> frozenset[str]:
    if ROS in container.labels:
        tokens = frozenset(re.split(r"[,\s]+", container.labels[ROS].strip()))
        if not tokens <= {"1", "2"}:
            text = f"{named(ROS, container.labels)} is none of 1, 2 and 1,2"
            raise UnusableLabel(text, f"Write {ROS}=2 for ROS 2")
        return tokens
    version = _version_of_image(container) or ("2" if _is_marked_ros2(container) else "1")
    return frozenset({version})


def _version_of_image(container: Container) -> str:
    """Return the version that ROS_VERSION or ROS_DISTRO states: 1 or 2; empty if neither does."""
    version = container.variables.get("ROS_VERSION", "")
    if version in ("1", "2"):
        return version
    distro = container.variables.get("ROS_DISTRO", "").lower()
    return ("1" if distro in ROS1_DISTROS else "2") if distro else ""


def _is_marked_ros2(container: Container) -> bool:
    """Whether a container has labels or variables of ROS 2 alone, and no ROS 1 master.

    ROS 2 treats an empty variable as unset (rcl, domain_id.c), so an empty variable states nothing.
    """
    if MASTER_URI in container.labels or container.master_uri:
        return False
    has_label = any(name in container.labels for name in _ROS2_LABELS)
    has_variable = any(container.variables.get(name) for name in ROS2_VARIABLES)
    return has_label or has_variable or container.is_zenoh_router


def domain(container: Container) -> int:
    """Return the domain of a container: from the label, else from ROS_DOMAIN_ID, else 0.

    Raises UnusableLabel.
    """
    if DOMAIN in container.labels:
        source = named(DOMAIN, container.labels)
        text = container.labels[DOMAIN]
    else:
        text = container.variables.get("ROS_DOMAIN_ID", "") or "0"
        source = f"variable ROS_DOMAIN_ID={quoted(text)}"
    digits = text.strip()
    if not re.fullmatch(r"[0-9]{1,3}", digits, re.ASCII) or int(digits) > LAST_DOMAIN:
        fix = f"Write the domain of the nodes into the label, such as {DOMAIN}=0"
        raise UnusableLabel(f"{source} is not a domain from 0 to {LAST_DOMAIN}", fix)
    return int(digits)


def refuse_ipv6_host(host: str) -> None:
    """Raise UnusableLabel if the advertised host is an IPv6 address."""
    if ":" in host:
        raise UnusableLabel(
            f"advertised host {host} is an IPv6 address, but the operator starts proxies for ROS 2 "
            "with IPv4 only",
            "Give an IPv4 address",
        )


def static_peer_warnings(
    container: Container, networks: Collection[str], observed: HostState
) -> Iterator[Fault]:
    """Yield warnings for hosts outside that the variable ROS_STATIC_PEERS of a container names.

    ``networks`` are the names of the container's networks. The nodes announce inside addresses
    directly to such a host, and the host can't reach these addresses. A participant keeps the first
    locators of another participant (Fast DDS: PDPListener.cpp), so the announcement of the proxy
    comes too late.
    """
    attachments = (a for c in observed.containers for a in c.attachments if a.network in networks)
    inside = {ALIAS, "localhost", *(name for a in attachments for name in a.names)}
    subnets = [s for n in observed.networks if n.name in networks for s in n.subnets]
    named_hosts = container.variables.get("ROS_STATIC_PEERS", "").split(";")
    for host in filter(None, (host.strip().lower() for host in named_hosts[:MOST_PEERS])):
        if host not in inside and not is_loopback(host) and not is_inside(host, subnets):
            yield Fault(
                f"variable ROS_STATIC_PEERS names {quoted(host)}, which is not on a network of "
                "this container. That host learns an address that it can't reach, and keeps that "
                "address",
                f"Unset the variable, and add the label {PEERS}={quoted(host)}",
            )


def is_guessed(container: Container) -> bool:
    """Whether no label and no variable states the ROS version of a container."""
    explicit = {ROS, MASTER_URI} & container.labels.keys() or container.master_uri
    is_stated = explicit or _version_of_image(container)
    return not is_stated and not _is_marked_ros2(container)


def warnings(container: Container, ros_versions: Collection[str]) -> Iterator[Fault]:
    """Yield warnings for a container of these versions. The container gets a proxy nevertheless."""
    labels = container.labels
    if is_guessed(container):
        text = f"{UNKNOWN_VERSION}, so the operator assumes ROS 1"
        yield Fault(text, f"Add the label {ROS}=1 or {ROS}=2")
    yield from (
        Fault(f"label {label} is ignored: {fault.text}", fault.fix)
        for label, fault in _ignored(ros_versions).items()
        if label in labels
    )


def _ignored(ros_versions: Collection[str]) -> dict[str, Fault]:
    """Return the labels without effect on a container of these versions, with reason and fix."""
    without_effect = Fault("the label has no effect on rmw_zenoh", "Remove the label")
    if ros_versions == {"zenoh"}:
        return dict.fromkeys(_NOT_ZENOH_LABELS, without_effect)
    ignored: dict[str, Fault] = {}
    if "1" not in ros_versions:
        ignored |= dict.fromkeys(_ROS1_LABELS, _of_another_version("1"))
    if "zenoh" in ros_versions:
        ignored[DOMAIN] = without_effect
    else:
        ignored |= dict.fromkeys(_NOT_DDS_LABELS, _OF_ZENOH)
    if not {"2", "zenoh"} & {*ros_versions}:
        ignored |= dict.fromkeys(_ROS2_LABELS, _of_another_version("2"))
    return ignored


def _of_another_version(version: str) -> Fault:
    return Fault(
        f"the label is for ROS {version}, the container is not",
        f"Remove the label, or set {ROS}={version} if the nodes use ROS {version}",
    )
