"""The ports of the range that the kernel may forward, with their locators: ports for user data.

The proxy reads and rewrites discovery. So the kernel forwards a port only if the participant
ignores discovery there: a port for user data of Fast DDS (`Participant.reads_discovery_at`). All
datagrams at such a port go to one locator.

A port that the kernel forwarded before the start stays in the list until the proxy maps the port,
until a participant reads discovery at the locator, or until no participant is left that could claim
the port. Meanwhile the kernel goes on forwarding.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from rosproxy.ros2.ports.mappings import PortMappings
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortPool


@dataclass(eq=False, slots=True)
class ForwardedPort:
    """A port and its locator, as `rosproxy.forwarding.fast_ports.LeaseHolder`.

    ``is_down`` stays False, because nothing reports whether a locator answers. ``fast_peers`` stays
    empty, because datagrams have no connections.
    """

    port: int
    target: HostPort
    label: str
    fast_port: int | None = None
    fast_peers: Mapping[str, int] = field(default_factory=dict)
    inside: bool = True
    trusted: bool = True
    is_down: bool = False
    fast_connections: int = 0

    def __post_init__(self) -> None:
        """Make the port its own fast port: user space and the kernel share the port."""
        self.fast_port = self.port

    @property
    def address(self) -> str:
        """The IP address at which the proxy reaches the participant."""
        return self.target.host

    @property
    def node_ports(self) -> tuple[int]:
        """The port of the locator."""
        return (self.target.port,)

    @property
    def caller_ids(self) -> list[str]:
        """The label under which the bytes are counted."""
        return [self.label]


class KernelPorts:
    """The ports that the kernel may forward, as `rosproxy.forwarding.fast_ports.LeaseHolders`.

    ``domains`` are the port mappings of each domain. ``pool`` has the ports of all domains.
    """

    def __init__(self, pool: PortPool) -> None:
        self.pool = pool
        self.domains: list[PortMappings] = []
        self._former: dict[int, ForwardedPort] = {}
        self._cached: dict[int, ForwardedPort] = {}
        self._cached_changes = -1

    @property
    def by_port(self) -> Mapping[int, ForwardedPort]:
        """The forwarded ports, by number."""
        changes = sum(mappings.changes for mappings in self.domains)
        if changes != self._cached_changes:
            self._cached_changes = changes
            self._cached = {forwarded.port: forwarded for forwarded in self._mapped()}
            if self._former:
                self._end_former()
            self._cached |= self._former
        return self._cached

    def __iter__(self) -> Iterator[ForwardedPort]:
        """Iterate over the forwarded ports."""
        return iter(list(self.by_port.values()))

    def note_former(self, forwards: Mapping[int, HostPort]) -> None:
        """Note the forwards of a former process; an empty mapping ends all former forwards."""
        self._former = {
            port: ForwardedPort(port, target, "a participant from before the start of the proxy")
            for port, target in forwards.items()
        }
        self._cached_changes = -1  # so that `by_port` is computed again

    def _end_former(self) -> None:
        """End former forwards of mapped ports, and to locators where discovery is read now."""
        mapped = {p: m for mappings in self.domains for p, (_, m) in mappings.by_port.items()}
        read_at = {mapping.target for mapping in mapped.values() if mapping.is_read}
        self._former = {
            port: former
            for port, former in self._former.items()
            if port not in mapped and former.target not in read_at
        }

    def _mapped(self) -> Iterator[ForwardedPort]:
        """Yield the mapped ports. A port with the same locator stays the same object."""
        for mappings in self.domains:
            for port, (participant, mapping) in mappings.by_port.items():
                if mapping.is_read:
                    continue
                label = f"{participant.guid_prefix} at {participant.address}"
                cached = self._cached.get(port)
                # For the kernel plane, another object is another lease (`ForwardSyncer`).
                if cached is not None and (cached.target, cached.label) == (mapping.target, label):
                    yield cached
                else:
                    yield ForwardedPort(port, mapping.target, label)
