"""What the operator can do to a Docker host: data, carried out by `docker.executor`.

Containers are named, not numbered: a plan may start what it has yet to create. The text of an
action says what it does, in one plain and harmless line.
"""

from typing import ClassVar

import msgspec

from rosproxy.access.layers import PolicyLayer
from rosproxy.leases.ports import PortRange
from rosproxy.net.addresses import HostPort
from rosproxy.telemetry.text import clean, listed
from rosproxy_operator.docker.planner.model import Key
from rosproxy_operator.proxy_spec.spec import OWN_SPEC, ProxySpec


class Action(msgspec.Struct, frozen=True):
    """Something to be done to the container or network ``name``; its text begins with ``does``."""

    does: ClassVar[str]
    name: str

    def __str__(self) -> str:
        return clean(f"{self.does} {self.name}{self._details()}")

    @property
    def log_fields(self) -> dict[str, str]:
        """What a log entry about it has as fields: the container's name, or the network's."""
        return {self.does.rpartition(" ")[2]: self.name}

    def _details(self) -> str:
        """The rest of the text."""
        return ""


class CreateNetwork(Action, frozen=True):
    """Create the uplink network, an ordinary bridge."""

    does = "create network"

    def _details(self) -> str:
        return ", a bridge: the uplink of all proxies"


class RemoveNetwork(Action, frozen=True):
    """Remove a network that the operator has made."""

    does = "remove network"


class _CreateContainer(Action, frozen=True):
    """Create one of a proxy's containers, without starting it."""

    does = "create container"
    key: Key
    range: PortRange


class CreateSandbox(_CreateContainer, frozen=True):
    """Create the sandbox of a proxy with this ``spec``, on the uplink network."""

    spec: ProxySpec = OWN_SPEC
    fingerprint: str = ""

    def _details(self) -> str:
        return f": sandbox with ports {self.range} for the proxy of the {self.key.graph}"


class Create(_CreateContainer, frozen=True):
    """Create the container in which a proxy runs, in the namespace of the one named ``sandbox``.

    ``replaces`` names the one in whose place it comes, if any. ``policy`` are the layers of its
    containers' labels. Of ROS 2: ``peers`` are told of its participants, and ``lan_relay`` is where
    its LAN relay listens, on the uplink's gateway.
    """

    sandbox: str
    spec: ProxySpec = OWN_SPEC
    fingerprint: str = ""
    replaces: str = ""
    policy: tuple[PolicyLayer, ...] = ()
    peers: tuple[str, ...] = ()
    lan_relay: HostPort | None = None

    def _details(self) -> str:
        instead = f", instead of {self.replaces}" if self.replaces else ""
        rights = ", with NET_ADMIN" if self.spec.data_plane == "kernel" else ""
        host = f" at {self.key.advertise_host}" if self.key.advertise_host else ""
        return (
            f": proxy of the {self.key.graph}{host}, "
            f"ports {self.range} of {self.sandbox}{rights}{instead}"
        )


class CreateLanRelay(_CreateContainer, frozen=True):
    """Create the LAN relay of a proxy for ROS 2, in the host's network.

    ``lan`` is this host's address on the LAN, ``bind`` where the LAN relay hears the proxy,
    ``proxy`` where the proxy hears the LAN relay.
    """

    lan: str
    bind: HostPort
    proxy: HostPort
    fingerprint: str = ""

    def _details(self) -> str:
        return (
            f": LAN relay of the {self.key.graph} between the LAN at {self.lan} and the proxy at "
            f"{self.proxy}"
        )


class CreateRedirect(_CreateContainer, frozen=True):
    """Create what sets rules in the network of a container, and ends.

    ``target`` is that container's id, ``started`` when it was started. There these ``addresses``
    are to lead to ``proxy``; without both, what led there is taken away.
    """

    target: str
    started: str
    addresses: tuple[HostPort, ...] = ()
    proxy: HostPort | None = None
    fingerprint: str = ""

    def _details(self) -> str:
        location = f"in the network of container {self.target[:12]}"
        if self.proxy is None:
            return f": removes the redirect of the {self.key.graph} {location}"
        addresses = listed(map(str, self.addresses))
        return f": redirects {addresses} to the proxy at {self.proxy} {location}"


class CreateFlush(_CreateContainer, frozen=True):
    """Create what deletes the host's conntrack entries for a sandbox's UDP ports, and ends."""

    fingerprint: str = ""

    def _details(self) -> str:
        return (
            f": deletes the host's conntrack entries for UDP ports {self.range} of the "
            f"{self.key.graph}"
        )


class Run(Action, frozen=True):
    """Start a container that does one thing, and wait until it has ended."""

    does = "run container"


class Start(Action, frozen=True):
    """Start a container that was created or has stopped."""

    does = "start container"


class Restart(Action, frozen=True):
    """End a proxy and start it again: it runs in a namespace that is there no more."""

    does = "restart container"


class Unpause(Action, frozen=True):
    """Resume a container that was paused."""

    does = "resume container"


class Rename(Action, frozen=True):
    """Give a container another name."""

    does = "rename container"
    new_name: str

    def _details(self) -> str:
        return f" to {self.new_name}"


class Connect(Action, frozen=True):
    """Join a sandbox to a network under these aliases."""

    does = "connect container"
    network: str
    aliases: tuple[str, ...]

    def _details(self) -> str:
        names = f" as {', '.join(self.aliases)}" if self.aliases else ""
        return f" to network {self.network}{names}"


class Disconnect(Action, frozen=True):
    """Take a sandbox off a network."""

    does = "disconnect container"
    network: str

    def _details(self) -> str:
        return f" from network {self.network}"


class Remove(Action, frozen=True):
    """Kill and remove a container.

    With ``retire`` no other proxy takes over: the proxy first unregisters its nodes at the master
    (ROS 1), or sends dispose messages for its participants (ROS 2). With ``stop`` it is ended
    properly first: it goes together with its network, and what the kernel forwards there would
    never be closed.
    """

    does = "remove container"
    why: str
    retire: bool = False
    stop: bool = False

    def _details(self) -> str:
        text = "after the proxy has told outside that its nodes have ended"
        return f" ({self.why})" + (f", {text}" if self.retire else "")
