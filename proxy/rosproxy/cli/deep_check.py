"""``rosproxy run --check --deep``: would a proxy with these settings be reached?

It takes the ports, as the proxy would, looks up the hosts, asks the master, and has the range tried
from outside; then it lets all go. Nothing is registered, and no node is looked for. It says what
the doctor would.
"""

import asyncio
import contextlib
import secrets
import socket

from msgspec.structs import replace

from rosproxy.admin.findings import DoctorFinding, error
from rosproxy.admin.range_probe import probe_range
from rosproxy.admin.requests import PortProbe, RangeProbe
from rosproxy.admin.status_document import PortsStatus, ProxyStatus, StatusSettings
from rosproxy.admin.udp_probe import try_udp
from rosproxy.app.binding import setting_error_if_taken
from rosproxy.app.holders import report_taken_ports
from rosproxy.app.ros1 import Ros1
from rosproxy.doctor.collect import look_at_master
from rosproxy.doctor.facts import DoctorFacts, SystemState
from rosproxy.doctor.rules import proxy as rules
from rosproxy.forwarding import datagrams
from rosproxy.net import sockets
from rosproxy.net.addresses import HostPort, is_loopback
from rosproxy.net.resolver import resolve
from rosproxy.ros1.protocol.master_methods import KNOWN_METHODS
from rosproxy.runtime import Runtime
from rosproxy.settings import SettingError, Settings


def deep_check(settings: Settings) -> list[DoctorFinding]:
    """All findings about settings, the first cause first."""
    return asyncio.run(_check(settings))


async def _check(settings: Settings) -> list[DoctorFinding]:
    runtime = Runtime(settings, KNOWN_METHODS)
    host, ports = settings.advertise_host, settings.ports
    facts = DoctorFacts(
        advertise_host=host,
        advertised_addresses=tuple(await resolve(host)),
        is_all_local=not settings.for_ros1 and all(is_loopback(p.host) for p in settings.ros2_peer),
        graph=SystemState(),
        status=ProxyStatus(
            settings=StatusSettings(ros=settings.ros, advertise_host=host),
            ports=PortsStatus(str(ports.listen), str(ports.advertise), free=len(ports.listen)),
        ),
    )
    if settings.for_ros1:
        address = settings.master_address
        master = await look_at_master(settings.master_uri, runtime.instance, address)
        facts = replace(facts, master=master)
    try:
        facts = replace(facts, probe=await _try_ports(runtime, facts.advertised_addresses))
    except SettingError as failure:
        facts = replace(facts, probe=RangeProbe())
        findings = [f for f in rules.setup(facts) if f.check != "ports"]
        return [*findings, error("ports", "ports", str(failure))]
    finally:
        await runtime.tasks.cancel()
    return list(rules.setup(facts))


async def _try_ports(runtime: Runtime, addresses: tuple[str, ...]) -> RangeProbe:
    """Take all ports, and have the range tried. Raises SettingError if they can't be had."""
    settings, probes = runtime.settings, tuple[PortProbe, ...]()
    if settings.for_ros1:
        probes += await _try_tcp(runtime)
    if settings.for_ros2:
        probes += await _try_udp(runtime, addresses)
    ports = {"--master-port": settings.master_port, "--publish-master": settings.publish_master}
    for option, port in ports.items():
        if port and settings.for_ros1:
            with setting_error_if_taken(option, f"port {port}"):
                sockets.listen(settings.bind, port).close()
    with setting_error_if_taken("--admin-bind", settings.admin):
        sockets.listen(await _own_address(settings.admin.host), settings.admin.port).close()
    return RangeProbe(probes)


async def _own_address(host: str) -> str:
    """Where to listen. Raises SettingError for a name that leads nowhere."""
    addresses = await resolve(host)
    if not addresses:
        raise SettingError("--admin-bind", f"{host} can't be resolved here")
    return addresses[0]


async def _try_tcp(runtime: Runtime) -> tuple[PortProbe, ...]:
    ros1 = Ros1(runtime)
    try:
        ros1.reserve_range()
        return (await probe_range(ros1.context, ros1.leases)).probes
    finally:
        ros1.leases.close_all()
        await ros1.context.upstream.close()


async def _try_udp(runtime: Runtime, addresses: tuple[str, ...]) -> tuple[PortProbe, ...]:
    """The first port of the range, where outside finds the domain."""
    settings = runtime.settings
    ports, taken = settings.ports, list[int]()
    with contextlib.ExitStack() as stack:
        bound: dict[int, socket.socket] = {}
        for port in ports.listen.ports():
            try:
                bound[port] = stack.enter_context(datagrams.bind(settings.bind, port))
            except OSError:
                taken.append(port)
        report_taken_ports("2", settings, taken, runtime.problems)
        first = ports.listen.first
        if first not in bound or not addresses:
            return ()
        heard, secret = asyncio.Event(), secrets.token_bytes(16)
        loop = asyncio.get_running_loop()
        loop.add_reader(bound[first], _listen_for, bound[first], secret, heard)
        try:
            outcome = await try_udp(HostPort(addresses[0], ports.advertise.first), secret, heard)
        finally:
            loop.remove_reader(bound[first])
    advertised = str(HostPort(settings.advertise_host, ports.advertise.first))
    return (PortProbe(first, advertised, outcome, "unknown", "udp"),)


def _listen_for(sock: socket.socket, secret: bytes, heard: asyncio.Event) -> None:
    with contextlib.suppress(OSError):
        if sock.recv(datagrams.LARGEST_DATAGRAM) == secret:
            heard.set()
