"""The actions of the operator on a Docker host, as data. `docker.executor` carries actions out.

Actions have the names of containers, not the ids: a plan may start a container that the same plan
creates. The text of an action is one line without control characters.
"""

from typing import ClassVar

import msgspec

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.output.text import clean, listed
from rosproxy.shared.policy.layers import PolicyLayer
from rosproxy.shared.ports import PortRange
from rosproxy_operator.proxy_spec.place import Place
from rosproxy_operator.proxy_spec.spec import OWN_SPEC, ProxySpec


class Action(msgspec.Struct, frozen=True):
    """An action on the container or network ``name``. The action's text begins with ``does``."""

    does: ClassVar[str]
    name: str

    def __str__(self) -> str:
        return clean(f"{self.does} {self.name}{self._details()}")

    @property
    def log_fields(self) -> dict[str, str]:
        """The fields of a log entry: the name, under ``container`` or ``network``."""
        return {self.does.rpartition(" ")[2]: self.name}

    def _details(self) -> str:
        """Return the rest of the text."""
        return ""


class CreateNetwork(Action, frozen=True):
    """Create the uplink network, an ordinary bridge."""

    does = "create network"

    def _details(self) -> str:
        return ", a bridge: the uplink of all proxies"


class RemoveNetwork(Action, frozen=True):
    """Remove a network that the operator has created."""

    does = "remove network"


class _CreateContainer(Action, frozen=True):
    """Create a container for the proxy of ``place``, and do not start the container.

    ``range`` are the ports of the proxy. In subclasses, ``fingerprint`` is a hash of the creation
    request.
    """

    does = "create container"
    place: Place
    range: PortRange


class CreateSandbox(_CreateContainer, frozen=True):
    """Create the sandbox of a proxy on the uplink network. ``spec`` has the proxy's options."""

    spec: ProxySpec = OWN_SPEC
    fingerprint: str = ""

    def _details(self) -> str:
        return f": sandbox with ports {self.range} for the proxy of the {self.place.graph}"


class Create(_CreateContainer, frozen=True):
    """Create the container of a proxy, in the network namespace of the container ``sandbox``.

    ``replaces`` is the name of the former container, or empty. ``policy`` has the layers from
    labels. ``peers`` are hosts for ROS 2, and routers for rmw_zenoh (`Member.peers`). ``links`` are
    proxies at other sites, for rmw_zenoh. ``lan_relay`` is the address and port of the LAN relay,
    for ROS 2.
    """

    sandbox: str
    spec: ProxySpec = OWN_SPEC
    fingerprint: str = ""
    replaces: str = ""
    policy: tuple[PolicyLayer, ...] = ()
    peers: tuple[str, ...] = ()
    lan_relay: HostPort | None = None
    links: tuple[str, ...] = ()

    def _details(self) -> str:
        instead = f", instead of {self.replaces}" if self.replaces else ""
        rights = ", with NET_ADMIN" if self.spec.data_plane == "kernel" else ""
        host = f" at {self.place.advertise_host}" if self.place.advertise_host else ""
        return (
            f": proxy of the {self.place.graph}{host}, "
            f"ports {self.range} of {self.sandbox}{rights}{instead}"
        )


class CreateLanRelay(_CreateContainer, frozen=True):
    """Create the LAN relay of a proxy for ROS 2, in the host's network.

    ``lan`` is this host's address on the LAN. The LAN relay receives from the proxy at ``bind``,
    and sends to the proxy at ``proxy``.
    """

    lan: str
    bind: HostPort
    proxy: HostPort
    fingerprint: str = ""

    def _details(self) -> str:
        return (
            f": LAN relay of the {self.place.graph} between the LAN at {self.lan} and the proxy at "
            f"{self.proxy}"
        )


class CreateRedirect(_CreateContainer, frozen=True):
    """Create a helper container that sets the rules of a redirect for a container.

    The rules are in the network namespace of the container with the id ``target``, and lead
    ``addresses`` to ``proxy``. ``started`` is the time of that container's start. If ``proxy`` is
    None, the helper removes the rules.
    """

    target: str
    started: str
    addresses: tuple[HostPort, ...] = ()
    proxy: HostPort | None = None
    fingerprint: str = ""

    def _details(self) -> str:
        location = f"in the network namespace of container {self.target[:12]}"
        if self.proxy is None:
            return f": removes the redirect of the {self.place.graph} {location}"
        addresses = listed(map(str, self.addresses))
        return f": redirects {addresses} to the proxy at {self.proxy} {location}"


class CreateFlush(_CreateContainer, frozen=True):
    """Create a helper container that deletes conntrack entries for a sandbox's UDP ports."""

    fingerprint: str = ""

    def _details(self) -> str:
        return (
            f": deletes the host's conntrack entries for UDP ports {self.range} of the "
            f"{self.place.graph}"
        )


class Run(Action, frozen=True):
    """Start a helper container, and wait until the helper has ended."""

    does = "run container"


class Start(Action, frozen=True):
    """Start a container that was created or has stopped."""

    does = "start container"


class Restart(Action, frozen=True):
    """Restart a proxy that still runs in the former network namespace of its sandbox."""

    does = "restart container"


class Unpause(Action, frozen=True):
    """Resume a paused container."""

    does = "resume container"


class Rename(Action, frozen=True):
    """Give a container another name."""

    does = "rename container"
    new_name: str

    def _details(self) -> str:
        return f" to {self.new_name}"


class Connect(Action, frozen=True):
    """Connect a sandbox to a network under ``aliases``."""

    does = "connect container"
    network: str
    aliases: tuple[str, ...]

    def _details(self) -> str:
        names = f" as {', '.join(self.aliases)}" if self.aliases else ""
        return f" to network {self.network}{names}"


class Disconnect(Action, frozen=True):
    """Disconnect a sandbox from a network."""

    does = "disconnect container"
    network: str

    def _details(self) -> str:
        return f" from network {self.network}"


class Remove(Action, frozen=True):
    """Kill and remove a container.

    ``reason`` is the text for log and plan. ``retire`` is for a proxy without a successor: the
    proxy first unregisters the nodes at the master (ROS 1), or sends dispose messages for the
    participants (ROS 2). ``stop`` is for a proxy whose network namespace is removed, too: the proxy
    first closes the connections that the kernel forwards. Otherwise these connections would never
    be closed.
    """

    does = "remove container"
    reason: str
    retire: bool = False
    stop: bool = False

    def _details(self) -> str:
        text = "after the proxy has told outside that its nodes have ended"
        return f" ({self.reason})" + (f", {text}" if self.retire else "")
