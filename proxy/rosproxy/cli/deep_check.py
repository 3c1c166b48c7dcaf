"""``rosproxy run --check --deep``: whether outside would reach a proxy with these settings.

The command binds the ports as the proxy does, resolves the hosts, asks the master, tests whether
outside reaches the range, and closes all ports. The command registers nothing and asks no nodes.
The findings are the findings of the doctor.
"""

import asyncio

from msgspec.structs import replace

from rosproxy.app.self_check import peer_addresses
from rosproxy.app.stacks import make_stacks
from rosproxy.binding import setting_error_if_taken
from rosproxy.doctor.facts import DoctorFacts, SystemState
from rosproxy.doctor.graph_survey import look_at_master
from rosproxy.doctor.rules import proxy as rules
from rosproxy.runtime import Runtime
from rosproxy.shared.connections import sockets
from rosproxy.shared.documents.doctor_finding import DoctorFinding, error
from rosproxy.shared.documents.requests import RangeProbe
from rosproxy.shared.documents.status_document import (
    DomainStatus,
    PortsStatus,
    ProxyStatus,
    StatusSettings,
)
from rosproxy.shared.machine.resolver import resolve
from rosproxy.shared.setting_kinds import SettingError
from rosproxy.shared.settings import Settings


def deep_check(settings: Settings) -> list[DoctorFinding]:
    """All findings about the settings, the first cause first. Binds and closes all ports."""
    return asyncio.run(_check(settings))


async def _check(settings: Settings) -> list[DoctorFinding]:
    runtime = Runtime(settings)
    host = settings.advertise_host
    ports = settings.ports
    facts = DoctorFacts(
        advertise_host=host,
        advertised_addresses=tuple(await resolve(host)) if host else (),
        # The check does not ask for the graph. None would mean that the master has not answered.
        graph=SystemState(),
        status=ProxyStatus(
            settings=StatusSettings(ros=settings.ros, advertise_host=host),
            ports=(
                PortsStatus(str(ports.listen), str(ports.advertise), free=len(ports.listen))
                if settings.range_versions
                else PortsStatus()
            ),
            domains=(await _outside_of_domain(settings),) if settings.for_ros2 else (),
        ),
    )
    if settings.for_ros1:
        address = settings.master_address
        master = await look_at_master(settings.master_uri, runtime.instance, address)
        facts = replace(facts, master=master)
    try:
        facts = replace(facts, probe=await _try_ports(runtime))
    except SettingError as failure:
        # An empty probe makes no finding; None would mean that the range was not tried. The number
        # of free ports means nothing if a port can't be bound.
        facts = replace(facts, probe=RangeProbe())
        findings = [f for f in rules.setup(facts) if f.check != "ports"]
        return [*findings, error("ports", "ports", str(failure))]
    finally:
        await runtime.tasks.cancel()
    return list(rules.setup(facts))


async def _outside_of_domain(settings: Settings) -> DomainStatus:
    """A domain with its peers and its LAN relay alone."""
    relay = settings.ros2_lan_relay
    return DomainStatus(
        peers=tuple(await peer_addresses(settings)), lan_relay=str(relay) if relay else ""
    )


async def _try_ports(runtime: Runtime) -> RangeProbe:
    """Bind all ports, and test the range. Raises SettingError if a port can't be bound."""
    settings = runtime.settings
    probes = [await stack.try_ports() for stack in make_stacks(runtime)]
    ports = {"--master-port": settings.master_port, "--publish-master": settings.publish_master}
    for option, port in ports.items():
        if port and settings.for_ros1:
            with setting_error_if_taken(option, f"port {port}"):
                sockets.listen(settings.bind, port).close()
    with setting_error_if_taken("--admin-bind", settings.admin):
        sockets.listen(await _own_address(settings.admin.host), settings.admin.port).close()
    return RangeProbe(tuple(probe for of_stack in probes for probe in of_stack))


async def _own_address(host: str) -> str:
    """The address to which a host of ``--admin-bind`` resolves. Raises SettingError if to none."""
    addresses = await resolve(host)
    if not addresses:
        raise SettingError("--admin-bind", f"the host name {host} can't be resolved here")
    return addresses[0]
