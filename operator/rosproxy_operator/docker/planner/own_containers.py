"""Decide which containers are the operator's own, by labels, name, user, command and HostConfig.

The operator has no disk, and recognises its containers by their labels. But an image may carry such
labels too, and variables, a command and a user. An image can't choose the name and the HostConfig
of a container; the client that creates the container chooses both. So a container counts as own
only if the operator would choose this name and HostConfig. Of all other containers, the operator
ignores the labels for range and place.

The labels have no signature, such as an HMAC. A client that chooses name and HostConfig has access
to the engine, and is root on the host. Such a client can read every secret of the operator, and
needs no forged container. And an operator without its former secret still has to recognise its
containers, to recreate them on the same ports.

Two kinds of fields are not checked. ``docker update`` changes the first kind on a running
container: memory, threads, restart policy. Options of the operator decide the second kind, such as
the uplink and the published addresses. If such an option changes, the operator recreates the
container, and so has to recognise the container.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from rosproxy_operator.common.ros2 import LAN_RELAY_COMMAND
from rosproxy_operator.docker.planner.specs import (
    FORMER_LAN_RELAY,
    HELPER_USER,
    LINK_MOUNT,
    NFT,
    PROXY_COMMAND,
    ROLE_FLUSH,
    ROLE_LAN_RELAY,
    ROLE_PROXY,
    ROLE_REDIRECT,
    ROLE_SANDBOX,
    SANDBOX_COMMAND,
    USER,
    OwnLabels,
    flush_command,
    flush_name,
    has_kernel_privileges,
    lan_relay_name,
    proxy_name,
    published_ports,
    redirect_name,
    sandbox_name,
)
from rosproxy_operator.docker.planner.zenoh_redirect import zenoh_sysctls
from rosproxy_operator.proxy_spec.place import ZENOH

_NAME_ENDINGS = r"(-\d+)?(-old(-\d+)?)?"
"""Pattern of the endings of a container's name: a number if the name is taken
(`duplicates.free_name`), or ``-old`` if another container takes over
(`container_steps.former_name`)."""
_FIELDS_NEVER_SET = (
    *("Privileged", "Binds", "VolumesFrom", "Devices", "DeviceRequests", "GroupAdd"),
    *("PidMode", "UTSMode", "UsernsMode"),
)
"""Fields of the HostConfig that the operator never sets. Only a proxy may have ``Mounts``."""
_OWN_IPC = (None, "", "private", "shareable")
"""Values that engines set as IpcMode by default."""
_COMMANDS = {
    ROLE_SANDBOX: SANDBOX_COMMAND,
    ROLE_PROXY: PROXY_COMMAND,
    ROLE_LAN_RELAY: LAN_RELAY_COMMAND,
    ROLE_REDIRECT: (NFT,),
}
_FORMER_LAN_RELAY_COMMAND = ("rosproxy", FORMER_LAN_RELAY)
_HELPERS = (ROLE_REDIRECT, ROLE_FLUSH)
_SANDBOX_SYSCTLS = {"net.ipv4.ip_local_port_range", "net.ipv4.ip_forward"}


@dataclass(frozen=True, slots=True)
class CreationFacts:
    """How a container was made, in the engine's words.

    ``image`` is the id of the image, ``host`` the HostConfig. ``command`` is the entry point and
    the command, from the image or from the client that created the container.
    """

    image: str = ""
    user: str = ""
    command: tuple[str, ...] = ()
    host: Mapping[str, Any] = field(default_factory=dict)


def has_own_name(own: OwnLabels, name: str) -> bool:
    """Whether the operator gives this name to a container with these labels."""
    names = [_expected_name(own)]
    if own.role == ROLE_LAN_RELAY:
        names.append(f"{proxy_name(own.place)}-{FORMER_LAN_RELAY}")
    return any(re.fullmatch(re.escape(each) + _NAME_ENDINGS, name) for each in names)


def forgery_reason(own: OwnLabels, name: str, creation: CreationFacts, image_id: str) -> str:
    """Return why a container with the operator's labels is not the operator's own.

    Empty if the container is the operator's own. ``image_id`` is the id of the present image of the
    proxies. A proxy of this image may have any command, since the operator leaves the command to
    the image. All other containers must have the command of their role.
    """
    if not has_own_name(own, name):
        return f"the name is not {_expected_name(own)}"
    user = HELPER_USER if own.role in _HELPERS else USER
    if creation.user != user:
        return f"the user is not {user}"
    if own.role == ROLE_FLUSH and creation.command != flush_command(own.place, own.range):
        return "the command is not the operator's"
    command = _COMMANDS.get(own.role, creation.command)
    of_image = own.role == ROLE_PROXY and creation.image == image_id
    # The rules are the last argument of a redirect's command. The check of the name covers the
    # rules, too: the name has the fingerprint of the rules.
    actual = creation.command[:1] if own.role == ROLE_REDIRECT else creation.command
    is_former = own.role == ROLE_LAN_RELAY and actual == _FORMER_LAN_RELAY_COMMAND
    if actual != command and not of_image and not is_former:
        return f"the command is not {' '.join(command)}"
    wrong_fields = {
        ROLE_SANDBOX: _wrong_sandbox_fields(own, creation.host),
        ROLE_PROXY: _wrong_proxy_fields(own, creation.host),
        ROLE_LAN_RELAY: _wrong_lan_relay_fields(creation.host),
        ROLE_REDIRECT: _wrong_redirect_fields(own, creation.host),
        ROLE_FLUSH: _wrong_flush_fields(creation.host),
    }
    return next((f"HostConfig.{name} is not the operator's" for name in wrong_fields[own.role]), "")


def _expected_name(own: OwnLabels) -> str:
    if own.role == ROLE_REDIRECT:
        return redirect_name(own.place, own.fingerprint)
    names = {ROLE_SANDBOX: sandbox_name, ROLE_LAN_RELAY: lan_relay_name, ROLE_FLUSH: flush_name}
    return names.get(own.role, proxy_name)(own.place)


def _wrong_fields(host: Mapping[str, Any]) -> Iterator[str]:
    """Yield the fields of a HostConfig whose values no container of the operator has."""
    if host.get("ReadonlyRootfs") is not True:
        yield "ReadonlyRootfs"
    if host.get("CapDrop") != ["ALL"]:
        yield "CapDrop"
    yield from (name for name in _FIELDS_NEVER_SET if host.get(name))
    if host.get("Mounts"):
        yield "Mounts"
    if host.get("IpcMode") not in _OWN_IPC:
        yield "IpcMode"


def _wrong_sandbox_fields(own: OwnLabels, host: Mapping[str, Any]) -> Iterator[str]:
    yield from _wrong_fields(host)
    if host.get("CapAdd"):
        yield "CapAdd"
    if host.get("SecurityOpt") != ["no-new-privileges:true"]:
        yield "SecurityOpt"
    mode = str(host.get("NetworkMode"))
    if mode in ("host", "none") or mode.startswith("container:"):
        yield "NetworkMode"
    bindings = host.get("PortBindings") or {}
    # No label says whether the ports are published for UDP as well, so both are valid.
    expected = [
        {name: {str(port)} for name, port in published_ports(own.place, own.range, udp)}
        for udp in (False, True)
    ]
    actual = {
        port: {str(binding.get("HostPort")) for binding in bindings_of_port or ()}
        for port, bindings_of_port in bindings.items()
    }
    if actual not in expected:
        yield "PortBindings"
    sysctls = (host.get("Sysctls") or {}).keys()
    if "net.ipv4.ip_local_port_range" not in sysctls or not sysctls <= _SANDBOX_SYSCTLS:
        yield "Sysctls"


def _wrong_lan_relay_fields(host: Mapping[str, Any]) -> Iterator[str]:
    """Yield the wrong fields of a LAN relay: it is in the host's network, without privileges."""
    yield from _wrong_fields(host)
    if host.get("CapAdd"):
        yield "CapAdd"
    if host.get("SecurityOpt") != ["no-new-privileges:true"]:
        yield "SecurityOpt"
    if host.get("NetworkMode") != "host":
        yield "NetworkMode"
    yield from (name for name in ("PortBindings", "Sysctls") if host.get(name))


def _wrong_redirect_fields(own: OwnLabels, host: Mapping[str, Any]) -> Iterator[str]:
    """Yield the wrong fields of a redirect.

    A redirect has NET_ADMIN in another container's network; for rmw_zenoh also a sysctl.
    """
    sysctls = frozenset(zenoh_sysctls(True)) if own.place == ZENOH else frozenset()
    yield from _wrong_helper_fields(host, sysctls)
    if not str(host.get("NetworkMode")).startswith("container:"):
        yield "NetworkMode"


def _wrong_flush_fields(host: Mapping[str, Any]) -> Iterator[str]:
    """Yield the wrong fields of a flush: it has NET_ADMIN in the host's network, and no more."""
    yield from _wrong_helper_fields(host)
    if host.get("NetworkMode") != "host":
        yield "NetworkMode"


def _wrong_helper_fields(
    host: Mapping[str, Any], sysctls: frozenset[str] = frozenset()
) -> Iterator[str]:
    yield from _wrong_fields(host)
    if [str(name).removeprefix("CAP_") for name in host.get("CapAdd") or ()] != ["NET_ADMIN"]:
        yield "CapAdd"
    if host.get("SecurityOpt") != ["no-new-privileges:true"]:
        yield "SecurityOpt"
    if host.get("PortBindings"):
        yield "PortBindings"
    if not (host.get("Sysctls") or {}).keys() <= sysctls:
        yield "Sysctls"


def _wrong_proxy_fields(own: OwnLabels, host: Mapping[str, Any]) -> Iterator[str]:
    # No label says whether the proxy has links, and the option may name another directory by now.
    mounts = [{key: mount.get(key) for key in LINK_MOUNT} for mount in host.get("Mounts") or ()]
    has_links = own.place == ZENOH and mounts == [LINK_MOUNT]
    yield from _wrong_fields({**host, "Mounts": None} if has_links else host)
    if not has_kernel_privileges(host):
        if host.get("CapAdd"):
            yield "CapAdd"
        if host.get("SecurityOpt") != ["no-new-privileges:true"]:
            yield "SecurityOpt"
    if not str(host.get("NetworkMode")).startswith("container:"):
        yield "NetworkMode"
    yield from (name for name in ("PortBindings", "Sysctls") if host.get(name))
