"""Plan the removal of everything that the operator has made on a Docker host.

The executor removes the following at the same time (`Group`):

- Each redirect in the network of a user's container, and then the records of this redirect.
- Each flush whose sandbox is gone.
- The proxy of each place, then the LAN relay and the sandbox. The proxy first tells outside that
  the nodes have ended.

After all proxies, LAN relays and sandboxes are gone, the operator removes the networks that it has
made.

If a new container of the operator appears during the removal, another operator is running. The
removal then stops with a problem.
"""

from collections.abc import Iterator

from rosproxy.shared.output.text import listed
from rosproxy_operator.common.problem import (
    STUCK,
    Problem,
)
from rosproxy_operator.docker.planner.actions import RemoveNetwork
from rosproxy_operator.docker.planner.container_steps import removal_steps
from rosproxy_operator.docker.planner.labels.members import LabelReading
from rosproxy_operator.docker.planner.model import SERVING, HostState
from rosproxy_operator.docker.planner.plan import DockerPlan, Group, flush_groups
from rosproxy_operator.docker.planner.redirect import redirect_steps
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.docker.settings import PlanSettings

UNINSTALL_REASON = "rosproxy is uninstalled"


class Uninstall:
    """Decides in place of `plan`, look after look. Remembers the containers of the first look."""

    def __init__(self) -> None:
        self._first: frozenset[str] | None = None

    def __call__(
        self,
        observed: HostState,
        _labels: LabelReading,
        settings: PlanSettings,
        memory: DockerMemory,
        _now: float,
    ) -> DockerPlan:
        """Return the next plan. Without actions, the removal is complete, or can't go on."""
        ids = frozenset(own.container.id for own in observed.own)
        if self._first is None:
            self._first = ids
        problem = _other_operator(observed, self._first)
        groups = () if problem else tuple(_groups(observed, settings))
        problems = (problem,) if problem else tuple(_remaining(observed, settings))
        return DockerPlan(groups, memory, problems, members=(), desired=())


def _other_operator(observed: HostState, first: frozenset[str]) -> Problem | None:
    """The problem that another operator creates containers; None without new containers."""
    new = [own.container.name for own in observed.own if own.container.id not in first]
    if not new:
        return None
    return Problem(
        "operator",
        f"another operator is running on this host, and has created {listed(new)} meanwhile",
        "Stop that operator (docker rm -f rosproxy-operator, or docker compose stop operator), "
        "then run uninstall again",
        reason="OtherOperator",
    )


def _groups(observed: HostState, settings: PlanSettings) -> Iterator[Group]:
    """The groups of everything that the operator can remove now."""
    busy = {own.place for own in observed.own if own.container.name in observed.busy}
    for steps in redirect_steps(observed, settings, ()):
        yield Group(steps.place, steps.actions, f"container {steps.container}")
    yield from flush_groups(observed, settings, (), {})
    for place in sorted(observed.places - busy):
        # With ``again``, the plan has also the containers that the engine removes already. So the
        # command does not end before these containers are gone and the networks can go.
        if actions := tuple(removal_steps(observed, place, UNINSTALL_REASON, again=True)):
            yield Group(place, actions)
    if not observed.own:
        for network in observed.networks:
            if network.made_by_operator and not _guests(observed, network.name):
                yield Group(None, (RemoveNetwork(network.name),))


def _remaining(observed: HostState, settings: PlanSettings) -> Iterator[Problem]:
    """The problems that keep the operator from removing networks and redirects."""
    for network in observed.networks:
        if guests := _guests(observed, network.name) if network.made_by_operator else []:
            yield Problem(
                f"network {network.name}",
                f"not removed, since containers are on this network: {listed(guests)}",
                f"Run docker network disconnect {network.name} {guests[0]}, then run uninstall "
                "again",
                reason="NetworkInUse",
            )
    if observed.redirects and not observed.image_id:
        names = {container.id: container.name for container in observed.containers}
        owners = (record.container.network_container or "" for record in observed.redirects)
        yield Problem(
            f"proxy image {settings.proxy_image}",
            "not on this host. The operator needs the image to remove the redirects in the networks"
            f" of {listed(sorted({names.get(owner, owner[:12]) for owner in owners}))}",
            f"Run docker pull {settings.proxy_image}, then run uninstall again",
            reason=STUCK,
        )


def _guests(observed: HostState, network: str) -> list[str]:
    """The names of users' containers that run on a network, or that the engine restarts.

    A container in the state restarting counts, since without the network it could not start.
    """
    return sorted(
        container.name
        for container in observed.containers
        if container.state in SERVING and network in container.networks
    )
