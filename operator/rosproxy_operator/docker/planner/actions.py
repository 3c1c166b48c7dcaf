"""What the operator can do to a Docker host: data, carried out by `docker.executor`.

Containers are named, not numbered: a plan may start what it has yet to create. The text of an
action says what it does, in one plain and harmless line.
"""

from dataclasses import dataclass

from rosproxy.leases.ports import PortRange
from rosproxy.settings import DataPlane
from rosproxy.telemetry.text import clean
from rosproxy_operator.docker.planner.model import Key


@dataclass(frozen=True, slots=True)
class CreateNetwork:
    """Create the uplink network, an ordinary bridge."""

    name: str

    def __str__(self) -> str:
        return clean(f"create network {self.name}, a bridge: the uplink of all proxies")


@dataclass(frozen=True, slots=True)
class CreateSandbox:
    """Create a sandbox on the uplink network, without starting it.

    With ``forwards`` the kernel may forward packets in its network namespace.
    """

    name: str
    key: Key
    range: PortRange
    fingerprint: str = ""
    forwards: bool = False

    def __str__(self) -> str:
        return clean(
            f"create container {self.name}: it holds ports {self.range} for the proxy of the "
            f"master {self.key.master_uri}"
        )


@dataclass(frozen=True, slots=True)
class Create:
    """Create a proxy's container in the namespace of the one named ``sandbox``; don't start it.

    ``replaces`` names the one in whose place it comes, if any.
    """

    name: str
    key: Key
    range: PortRange
    sandbox: str
    data_plane: DataPlane = "auto"
    fingerprint: str = ""
    replaces: str = ""

    def __str__(self) -> str:
        instead = f", instead of {self.replaces}" if self.replaces else ""
        rights = ", with NET_ADMIN" if self.data_plane == "kernel" else ""
        return clean(
            f"create container {self.name}: proxy of the master {self.key.master_uri} at "
            f"{self.key.advertise_host}, ports {self.range} of {self.sandbox}{rights}{instead}"
        )


@dataclass(frozen=True, slots=True)
class Start:
    """Start a container that was created or has stopped."""

    name: str

    def __str__(self) -> str:
        return clean(f"start container {self.name}")


@dataclass(frozen=True, slots=True)
class Restart:
    """End a proxy and start it again: it runs in a namespace that is there no more."""

    name: str

    def __str__(self) -> str:
        return clean(f"restart container {self.name}")


@dataclass(frozen=True, slots=True)
class Unpause:
    """Resume a container that was paused."""

    name: str

    def __str__(self) -> str:
        return clean(f"resume container {self.name}")


@dataclass(frozen=True, slots=True)
class Rename:
    """Give a container another name."""

    name: str
    to: str

    def __str__(self) -> str:
        return clean(f"rename container {self.name} to {self.to}")


@dataclass(frozen=True, slots=True)
class Connect:
    """Join a sandbox to a network under these aliases."""

    name: str
    network: str
    aliases: tuple[str, ...]

    def __str__(self) -> str:
        names = f" as {', '.join(self.aliases)}" if self.aliases else ""
        return clean(f"connect container {self.name} to network {self.network}{names}")


@dataclass(frozen=True, slots=True)
class Disconnect:
    """Take a sandbox off a network."""

    name: str
    network: str

    def __str__(self) -> str:
        return clean(f"disconnect container {self.name} from network {self.network}")


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

    def __str__(self) -> str:
        after = ", after unregistering its nodes at the master" if self.retire else ""
        return clean(f"remove container {self.name} ({self.why}){after}")


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
