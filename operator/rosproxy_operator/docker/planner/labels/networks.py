"""On which networks a container meets its proxy."""

from rosproxy_operator.docker.planner.labels.values import NETWORK, UnusableLabel, quoted
from rosproxy_operator.docker.planner.model import Container, HostState

BUILT_IN = frozenset({"bridge", "host", "none"})
"""Networks that every engine has. No names resolve on them, so no proxy can be found there."""
_COMPOSE_PROJECT = "com.docker.compose.project"
_WITH = "container:"


def networks(
    container: Container, observed: HostState, uplink: str, label: str | None
) -> frozenset[str]:
    """The container's user-defined networks but the uplink, or the one that its label names.

    Raises UnusableLabel if it has none, or not that one.
    """
    owner = _owner(container, observed)
    own = (owner.networks or _soon(owner, observed)) - BUILT_IN - {uplink}
    if label is not None:
        return frozenset({_named(label, container, own)})
    if not own:
        raise UnusableLabel(_why_none(owner))
    return own


def _soon(container: Container, observed: HostState) -> frozenset[str]:
    """The network of a container that the engine is just creating, and lists without any."""
    if container.state != "created":
        return frozenset()
    mode = container.network_mode
    return frozenset(one.name for one in observed.networks if mode in (one.name, one.id))


def _named(label: str, container: Container, own: frozenset[str]) -> str:
    """The network that a label means; compose puts its project's name in front."""
    project = container.labels.get(_COMPOSE_PROJECT)
    for name in (label, f"{project}_{label}"):
        if name in own:
            return name
    there = ", ".join(sorted(own)) or "none that is user-defined"
    raise UnusableLabel(
        f"label {NETWORK}={quoted(label)} names no network of the container; it has: {there}"
    )


def _owner(container: Container, observed: HostState) -> Container:
    """The container whose networks it has: its own, or those of the one that it shares them with.

    Raises UnusableLabel if that one is not there.
    """
    met = {container.id}
    while container.network_mode.startswith(_WITH):
        wanted = container.network_mode.removeprefix(_WITH)
        found = next((one for one in observed.containers if wanted in (one.id, one.name)), None)
        if found is None or found.id in met:
            raise UnusableLabel(
                f"shares the network of a container ({quoted(wanted)}) that is not there: start "
                "that one, then create this one anew"
            )
        met.add(found.id)
        container = found
    return container


def _why_none(owner: Container) -> str:
    fix = "attach it to a user-defined network: docker network create ros; docker run --network ros"
    if "host" in (*owner.networks, owner.network_mode):
        return (
            f"is on the host's own network, where its nodes need no proxy: {fix}, or take its "
            "labels off"
        )
    if "bridge" in owner.networks or owner.network_mode in ("bridge", "default"):
        return f"is only on the default bridge network, where no names resolve: {fix}"
    return f"is on no network: {fix}"
