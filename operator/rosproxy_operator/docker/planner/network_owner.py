"""Find the container that owns the network namespace of another container.

With ``--network container:…`` a container shares the namespace of another container, which may
itself share the namespace of a third container. The engine keeps the id of the other container, or
the given name if no such container existed at the creation (moby: daemon/daemon_unix.go).
"""

from collections.abc import Iterable, Mapping

from rosproxy_operator.docker.planner.model import Container

ByReference = Mapping[str, Container]
"""Containers by id and by name."""


class NoOwner(Exception):
    """No container owns the namespace: ``target`` does not exist, or the containers form a loop."""

    def __init__(self, target: str, is_loop: bool) -> None:
        super().__init__(target)
        self.target = target
        self.is_loop = is_loop


def by_reference(containers: Iterable[Container]) -> ByReference:
    """Return the containers by id and by name. An id takes precedence over an equal name."""
    every = tuple(containers)
    return {c.name: c for c in every} | {c.id: c for c in every}


def find_network_owner(container: Container, containers: ByReference) -> Container:
    """Return the container that owns the network namespace of ``container``. Raises NoOwner."""
    visited = {container.id}
    while (target := container.network_container) is not None:
        other = containers.get(target)
        if other is None or other.id in visited:
            raise NoOwner(target, is_loop=other is not None)
        visited.add(other.id)
        container = other
    return container


def network_owner(container: Container, containers: ByReference) -> Container:
    """Return the owner of the network namespace of ``container``; without one, ``container``."""
    try:
        return find_network_owner(container, containers)
    except NoOwner:
        return container
