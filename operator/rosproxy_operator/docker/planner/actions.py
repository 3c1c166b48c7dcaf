"""What the operator can do to a Docker host: data, carried out by `rosproxy_operator.docker.apply`.

Containers are named, not numbered: a plan may start what it has yet to create.
"""

from dataclasses import dataclass

from rosproxy.leases.ports import PortRange
from rosproxy.settings import DataPlane
from rosproxy_operator.docker.planner.model import Key


@dataclass(frozen=True, slots=True)
class SandboxSpec:
    """A sandbox to create: the container with a proxy's network namespace and published ports.

    With ``forwards`` the kernel may forward packets in that namespace.
    """

    name: str
    key: Key
    range: PortRange
    fingerprint: str
    uplink: str
    forwards: bool = False


@dataclass(frozen=True, slots=True)
class ProxySpec:
    """A proxy's container to create, in the namespace of the container named ``sandbox``.

    ``replaces`` names the one whose token it takes over, if any.
    """

    name: str
    key: Key
    range: PortRange
    fingerprint: str
    sandbox: str
    replaces: str = ""
    data_plane: DataPlane = "auto"


@dataclass(frozen=True, slots=True)
class CreateNetwork:
    """Create the uplink network, an ordinary bridge."""

    name: str


@dataclass(frozen=True, slots=True)
class CreateSandbox:
    """Create a sandbox on the uplink network, without starting it."""

    sandbox: SandboxSpec


@dataclass(frozen=True, slots=True)
class Create:
    """Create a proxy's container, without starting it."""

    proxy: ProxySpec


@dataclass(frozen=True, slots=True)
class Start:
    """Start a container that was created or has stopped."""

    name: str


@dataclass(frozen=True, slots=True)
class Restart:
    """End a proxy and start it again: it runs in a namespace that is there no more."""

    name: str


@dataclass(frozen=True, slots=True)
class Unpause:
    """Resume a container that was paused."""

    name: str


@dataclass(frozen=True, slots=True)
class Rename:
    """Give a container another name."""

    name: str
    to: str


@dataclass(frozen=True, slots=True)
class Connect:
    """Join a sandbox to a network under these aliases."""

    name: str
    network: str
    aliases: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Disconnect:
    """Take a sandbox off a network."""

    name: str
    network: str


@dataclass(frozen=True, slots=True)
class Remove:
    """Kill and remove a container.

    With ``retire`` the proxy's nodes are unregistered at the master first: nobody takes over. With
    ``stop`` it is ended properly first: it goes together with its network, and what the kernel
    forwards there would never be closed.
    """

    name: str
    why: str
    retire: bool = False
    stop: bool = False


Action = (
    CreateNetwork
    | CreateSandbox
    | Create
    | Start
    | Restart
    | Unpause
    | Rename
    | Connect
    | Disconnect
    | Remove
)
