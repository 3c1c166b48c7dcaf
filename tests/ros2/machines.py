"""The machines of this layer: machines of the real-ROS layer, each with a separate /dev/shm.

    out (robot) -- host (NAT, published ports, the LAN relay) -- bridge -- px (the proxy), c1, c2

Participants compare machines to choose shared memory. Two containers may look like the same machine
without sharing memory. Here all machines look alike.

With two hosts, all of this exists twice, with the same addresses inside, and with connected LANs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from tests.ros.processes import wait_until
from tests.ros.topology import Place, Plan, PortMap, Topology, run_command

PORTS = PortMap(47100, 47163, 47100)
PLAN = Plan("r", (("c1", "c2"),), PORTS)
ISOLATED = Plan("q", (("c1", "c2"),), PORTS, isolated=True)
OTHER_PLAN = replace(PLAN, name="o", host="10.77.0.11", robot="10.77.0.12")


class Machines(Protocol):
    """An object with machines: a topology, or the world of a benchmark."""

    places: dict[str, Place]


@dataclass
class Machine(Place):
    """A place with a separate /dev/shm, which is a folder."""

    shared_memory: Path = Path("/dev/shm")

    def command(self, argv: Sequence[str]) -> list[str]:
        """The command line that runs `argv` there, as a single process."""
        mount = f'mount --bind {self.shared_memory} /dev/shm && exec "$@"'
        return super().command(["unshare", "--mount", "sh", "-c", mount, "sh", *argv])


@contextmanager
def built(plan: Plan, folder: Path) -> Iterator[Topology]:
    """The machines of a plan with links that are up, removed at the end."""
    topology = Topology(plan)
    try:
        topology.build()
        with_shared_memory(topology, folder)
        wait_for_links(topology)
        yield topology
    finally:
        topology.remove()


def with_shared_memory(topology: Topology, folder: Path) -> None:
    """Give each machine of a topology a separate /dev/shm."""
    for role, place in topology.places.items():
        own = folder / f"shm-{role}"
        own.mkdir()
        topology.places[role] = Machine(
            place.role, place.namespace, place.hostname, place.addresses, own
        )


def join_lans(first: Topology, second: Topology) -> None:
    """Connect the LANs of two topologies."""
    first_namespace, second_namespace = (
        topology.places["host"].namespace for topology in (first, second)
    )
    peer = ("peer", "name", "lan9", "netns", second_namespace)
    run_command("ip", "-n", first_namespace, "link", "add", "lan9", "type", "veth", *peer)
    for namespace in (first_namespace, second_namespace):
        run_command("ip", "-n", namespace, "link", "set", "lan9", "master", "out0", "up")


def wait_for_links(topology: Machines) -> None:
    """Wait until all interfaces run: a participant that starts earlier knows loopback alone."""
    for place in topology.places.values():
        wait_until(f"the links of {place.role} are up", lambda place=place: _runs(place), 20)


def _runs(place: Place) -> bool:
    addresses = run_command("ip", "-n", place.namespace, "-o", "addr", "show")
    links = run_command("ip", "-n", place.namespace, "-o", "link", "show", "up")
    return "tentative" not in addresses and "NO-CARRIER" not in links
