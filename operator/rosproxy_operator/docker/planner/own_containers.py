"""Which containers are this operator's own: their labels say so, and nothing gives them away.

The operator has no disk, so it knows its containers by their labels; but an image may carry labels
as well, together with variables, a command and a user. What an image has no say in is the
container's name and its HostConfig: these belong to whoever creates the container. So one is own
only if both are as this operator makes them, and nothing is read of one that is not: neither its
range nor its key.

There is no mark besides that only the operator could compute (an HMAC in a label). Who can create
containers with a name and a HostConfig of his choice speaks to the engine, and is root on its host:
he can read any secret of the operator's, and needs no forged container. And an operator that has
lost its secret still has to know its containers, to make them anew on the same ports.

What ``docker update`` may change on a running container (memory, threads, restart policy) is not
looked at, nor what options of the operator decide, as the uplink or the published addresses: these
make a container anew, and must not make a stranger of it.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from rosproxy_operator.common.ros2 import LAN_RELAY_COMMAND
from rosproxy_operator.docker.planner.model import ZENOH
from rosproxy_operator.docker.planner.specs import (
    FORMER_LAN_RELAY,
    HELPER_USER,
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
    is_kernel_host,
    lan_relay_name,
    proxy_name,
    published_ports,
    redirect_name,
    sandbox_name,
)
from rosproxy_operator.docker.planner.zenoh_redirect import zenoh_sysctls

_TEMPORARY = r"(-\d+)?(-old(-\d+)?)?"
"""What follows a name while another container takes over or has it (`duplicates.free_name`)."""
_NEVER = (
    *("Privileged", "Binds", "Mounts", "VolumesFrom", "Devices", "DeviceRequests", "GroupAdd"),
    *("PidMode", "UTSMode", "UsernsMode"),
)
"""Fields of the HostConfig that the operator never sets."""
_OWN_IPC = (None, "", "private", "shareable")
"""What engines set as IpcMode by default."""
_COMMANDS = {
    ROLE_SANDBOX: SANDBOX_COMMAND,
    ROLE_PROXY: PROXY_COMMAND,
    ROLE_LAN_RELAY: LAN_RELAY_COMMAND,
    ROLE_REDIRECT: (NFT,),
}
_FORMER_COMMAND = ("rosproxy", FORMER_LAN_RELAY)
_HELPERS = (ROLE_REDIRECT, ROLE_FLUSH)
_SYSCTLS = {"net.ipv4.ip_local_port_range", "net.ipv4.ip_forward"}


@dataclass(frozen=True, slots=True)
class CreationFacts:
    """How a container was made, in the engine's words.

    ``image`` is the id of its image, ``host`` its HostConfig. ``command`` are entry point and
    command, whether given or the image's.
    """

    image: str = ""
    user: str = ""
    command: tuple[str, ...] = ()
    host: Mapping[str, Any] = field(default_factory=dict)


def has_own_name(own: OwnLabels, name: str) -> bool:
    """Whether a name is one that a container with these labels can have."""
    names = [_name(own)]
    if own.role == ROLE_LAN_RELAY:
        names.append(f"{proxy_name(own.key)}-{FORMER_LAN_RELAY}")
    return any(re.fullmatch(re.escape(each) + _TEMPORARY, name) for each in names)


def forgery_reason(own: OwnLabels, name: str, making: CreationFacts, image_id: str) -> str:
    """What shows that a container is none of this operator's, though its labels say so.

    Empty if nothing does. ``image_id`` is that of the proxies' image now. A container of a former
    image must at least have the user and the command of one.
    """
    if not has_own_name(own, name):
        return f"the name is not {_name(own)}"
    user = HELPER_USER if own.role in _HELPERS else USER
    if making.user != user:
        return f"the user is not {user}"
    if own.role == ROLE_FLUSH and making.command != flush_command(own.key, own.range):
        return "the command is not the operator's"
    command = _COMMANDS.get(own.role, making.command)
    of_image = own.role == ROLE_PROXY and making.image == image_id
    # What a redirect runs ends with its rules: they are in its fingerprint, and so in its name.
    actual = making.command[:1] if own.role == ROLE_REDIRECT else making.command
    is_former = own.role == ROLE_LAN_RELAY and actual == _FORMER_COMMAND
    if actual != command and not of_image and not is_former:
        return f"the command is not {' '.join(command)}"
    odd = {
        ROLE_SANDBOX: _odd_sandbox(own, making.host),
        ROLE_PROXY: _odd_proxy(making.host),
        ROLE_LAN_RELAY: _odd_lan_relay(making.host),
        ROLE_REDIRECT: _odd_redirect(own, making.host),
        ROLE_FLUSH: _odd_flush(making.host),
    }
    return next((f"HostConfig.{name} is not the operator's" for name in odd[own.role]), "")


def _name(own: OwnLabels) -> str:
    if own.role == ROLE_REDIRECT:
        return redirect_name(own.key, own.fingerprint)
    names = {ROLE_SANDBOX: sandbox_name, ROLE_LAN_RELAY: lan_relay_name, ROLE_FLUSH: flush_name}
    return names.get(own.role, proxy_name)(own.key)


def _odd(host: Mapping[str, Any]) -> Iterator[str]:
    """The fields of a HostConfig that differ from what all containers of the operator have."""
    if host.get("ReadonlyRootfs") is not True:
        yield "ReadonlyRootfs"
    if host.get("CapDrop") != ["ALL"]:
        yield "CapDrop"
    yield from (name for name in _NEVER if host.get(name))
    if host.get("IpcMode") not in _OWN_IPC:
        yield "IpcMode"


def _odd_sandbox(own: OwnLabels, host: Mapping[str, Any]) -> Iterator[str]:
    yield from _odd(host)
    if host.get("CapAdd"):
        yield "CapAdd"
    if host.get("SecurityOpt") != ["no-new-privileges:true"]:
        yield "SecurityOpt"
    mode = str(host.get("NetworkMode"))
    if mode in ("host", "none") or mode.startswith("container:"):
        yield "NetworkMode"
    bindings = host.get("PortBindings") or {}
    # No label says whether its ports are published for UDP as well, so both will do.
    expected = [
        {name: {str(port)} for name, port in published_ports(own.key, own.range, udp)}
        for udp in (False, True)
    ]
    actual = {
        port: {str(binding.get("HostPort")) for binding in bindings_of_port or ()}
        for port, bindings_of_port in bindings.items()
    }
    if actual not in expected:
        yield "PortBindings"
    sysctls = (host.get("Sysctls") or {}).keys()
    if "net.ipv4.ip_local_port_range" not in sysctls or not sysctls <= _SYSCTLS:
        yield "Sysctls"


def _odd_lan_relay(host: Mapping[str, Any]) -> Iterator[str]:
    """A LAN relay is in the host's network, and has no other right."""
    yield from _odd(host)
    if host.get("CapAdd"):
        yield "CapAdd"
    if host.get("SecurityOpt") != ["no-new-privileges:true"]:
        yield "SecurityOpt"
    if host.get("NetworkMode") != "host":
        yield "NetworkMode"
    yield from (name for name in ("PortBindings", "Sysctls") if host.get(name))


def _odd_redirect(own: OwnLabels, host: Mapping[str, Any]) -> Iterator[str]:
    """It has NET_ADMIN in another container's network; for rmw_zenoh, it has a sysctl there."""
    sysctls = frozenset(zenoh_sysctls(True)) if own.key == ZENOH else frozenset()
    yield from _odd_helper(host, sysctls)
    if not str(host.get("NetworkMode")).startswith("container:"):
        yield "NetworkMode"


def _odd_flush(host: Mapping[str, Any]) -> Iterator[str]:
    """It has NET_ADMIN in the host's network, and nothing else."""
    yield from _odd_helper(host)
    if host.get("NetworkMode") != "host":
        yield "NetworkMode"


def _odd_helper(host: Mapping[str, Any], sysctls: frozenset[str] = frozenset()) -> Iterator[str]:
    yield from _odd(host)
    if [str(name).removeprefix("CAP_") for name in host.get("CapAdd") or ()] != ["NET_ADMIN"]:
        yield "CapAdd"
    if host.get("SecurityOpt") != ["no-new-privileges:true"]:
        yield "SecurityOpt"
    if host.get("PortBindings"):
        yield "PortBindings"
    if not (host.get("Sysctls") or {}).keys() <= sysctls:
        yield "Sysctls"


def _odd_proxy(host: Mapping[str, Any]) -> Iterator[str]:
    yield from _odd(host)
    if not is_kernel_host(host):
        if host.get("CapAdd"):
            yield "CapAdd"
        if host.get("SecurityOpt") != ["no-new-privileges:true"]:
            yield "SecurityOpt"
    if not str(host.get("NetworkMode")).startswith("container:"):
        yield "NetworkMode"
    yield from (name for name in ("PortBindings", "Sysctls") if host.get(name))
