"""What the steps for one proxy are planned from."""

from collections.abc import Iterator
from dataclasses import dataclass

from rosproxy.leases.ports import PortRange
from rosproxy_operator.docker.planner.actions import Action, Remove, Rename
from rosproxy_operator.docker.planner.aliases import Aliases
from rosproxy_operator.docker.planner.model import (
    Container,
    Desired,
    HostState,
    Key,
    PlanSettings,
    Proxy,
    Sandbox,
)
from rosproxy_operator.docker.planner.selection import free_name


@dataclass(frozen=True, slots=True)
class PlanContext:
    """One key that is wanted, what there is for it, and what it gets.

    ``creatable``: the image and the uplink are there or can be made.
    """

    observed: HostState
    settings: PlanSettings
    desired: Desired
    ports: PortRange
    aliases: Aliases
    creatable: bool

    @property
    def key(self) -> Key:
        """The proxy's key."""
        return self.desired.key

    @property
    def sandboxes(self) -> tuple[Sandbox, ...]:
        """The key's sandboxes."""
        return self.observed.sandboxes_of(self.key)

    @property
    def proxies(self) -> tuple[Proxy, ...]:
        """The key's proxies."""
        return self.observed.proxies_of(self.key)

    def taken(self, own: tuple[Container, ...]) -> frozenset[str]:
        """The names of all containers but these."""
        every = [*self.observed.containers, *(one.container for one in self.observed.own)]
        return frozenset(one.name for one in every) - {one.name for one in own}


def removed(containers: tuple[Container, ...], why: str) -> Iterator[Remove]:
    """Remove these containers."""
    for container in containers:
        yield Remove(container.name, why)


def stopped(containers: tuple[Container, ...], why: str) -> Iterator[Remove]:
    """Remove these containers, but end them properly first."""
    for container in containers:
        yield Remove(container.name, why, stop=True)


def named(container: Container, name: str, taken: frozenset[str]) -> Iterator[Action]:
    """Give a container the name that it is to have, if nobody else has it."""
    if container.name != name and name not in taken:
        yield Rename(container.name, name)


def former_name(now: str, name: str, taken: frozenset[str]) -> str:
    """What to call a container, so that the one that takes over can have the name."""
    return free_name(f"{name}-old", taken) if now == name else now


def lives_in(container: Container, sandbox_id: str) -> bool:
    """Whether a container shares the network namespace of the one with this id."""
    return bool(sandbox_id) and container.network_mode == f"container:{sandbox_id}"


def inhabitants(context: PlanContext, sandbox_id: str) -> tuple[Container, ...]:
    """The key's proxies that are in a sandbox and not being removed already."""
    return tuple(
        one.container
        for one in context.proxies
        if lives_in(one.container, sandbox_id) and one.container.state != "removing"
    )
