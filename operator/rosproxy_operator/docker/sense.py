"""A whole look: the engine, and where the masters are that its containers name."""

from dataclasses import replace

from rosproxy.net.addresses import is_address
from rosproxy.ros1.protocol.uris import parse_slave_uri
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.common.resolver import THIS_HOST, MasterResolver
from rosproxy_operator.docker import host
from rosproxy_operator.docker.details import PATIENCE
from rosproxy_operator.docker.planner.labels import masters as master_uris
from rosproxy_operator.docker.planner.model import STARTED, Observed
from rosproxy_operator.docker.planner.settings import PlanSettings
from rosproxy_operator.docker.snapshot import Look, Observer


async def sense(
    observer: Observer, masters: MasterResolver, settings: PlanSettings, patience: float = PATIENCE
) -> Look:
    """Look at the engine, resolve the masters' hosts, and find this host's address towards them.

    Raises EngineError.
    """
    look = await observer.look(patience)
    hosts = master_hosts(look.observed, settings)
    known = {name: address for name in hosts if (address := _in_engine(name, look, settings))}
    never = [a.address for box in look.observed.sandboxes for a in box.container.attachments]
    await masters.learn(hosts, known, never)
    if not look.at_host:
        return look
    gateways = {network.gateway for network in look.observed.networks}
    advertise = {
        name: own
        for name in hosts
        if (there := masters.address(name)) and (own := host.own_address_towards(there, gateways))
    }
    return replace(look, observed=replace(look.observed, advertise=advertise))


def master_hosts(observed: Observed, settings: PlanSettings) -> list[str]:
    """The hosts of all masters, in lower case."""
    found = map(parse_slave_uri, master_uris(observed, settings))
    return sorted({where.host.lower() for where in found if where})


def unresolved(look: Look, masters: MasterResolver, settings: PlanSettings) -> list[Problem]:
    """The masters whose hosts can't be resolved, and what to do about it."""
    return [
        Problem(
            f"master {name}",
            f"the name {name} can't be resolved where the controller runs: give the master's "
            f"address instead, or the controller that name (/etc/hosts; in a container: "
            f"--add-host {name}:ADDRESS)",
        )
        for name in master_hosts(look.observed, settings)
        if not masters.address(name)
    ]


def _in_engine(name: str, look: Look, settings: PlanSettings) -> str:
    """The address of a host's name that no name server has: this host, or a container."""
    observed = look.observed
    if is_address(name):
        return ""
    if name == THIS_HOST:
        return next((n.gateway for n in observed.networks if n.name == settings.uplink), "")
    return next(
        (
            attachment.address
            for container in observed.containers
            for attachment in container.attachments
            if container.state in STARTED
            and attachment.address
            and name in {known.lower() for known in attachment.names}
        ),
        "",
    )
