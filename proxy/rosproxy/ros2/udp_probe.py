"""Probe whether UDP to the advertised host reaches the range. The proxy itself sends the probe.

In ROS 2 the proxy can't ask a participant outside to send a probe. The probe of the proxy fails
behind NAT without hairpinning, although outside may reach the range. So a failed probe does not
prove that outside can't reach the range.
"""

import asyncio
import contextlib
import secrets
import socket

from rosproxy.binding import report_taken_ports
from rosproxy.forwarding import datagrams
from rosproxy.runtime import Runtime
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.documents.requests import PortProbe
from rosproxy.shared.machine.resolver import resolve

ATTEMPTS = 3
"""Datagrams that the proxy sends, because UDP may lose some."""
ARRIVAL_TIMEOUT_S = 1.0
"""Seconds in which each of these datagrams may arrive."""


async def try_udp(target: HostPort, secret: bytes, heard: asyncio.Event) -> str:
    """Send a secret to an IP address and port until ``heard`` is set.

    Return ``ok``, ``silent`` if the event was not set, or ``unreachable`` if sending failed.
    """
    family = socket.AF_INET6 if ":" in target.host else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM) as sock:
        for _ in range(ATTEMPTS):
            try:
                sock.sendto(secret, (target.host, target.port))
            except OSError:
                return "unreachable"
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(ARRIVAL_TIMEOUT_S):
                    await heard.wait()
                return "ok"
    return "silent"


async def try_ports(runtime: Runtime) -> tuple[PortProbe, ...]:
    """Bind all ports of the range, and probe the discovery port of the first domain.

    This is the first port of the range. The result is empty if this port is not available, or if
    the advertised host has no address. Raises SettingError if no port is available.
    """
    settings = runtime.settings
    addresses = await resolve(runtime.settings.advertise_host)
    ports = settings.ports
    taken = list[int]()
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
        heard = asyncio.Event()
        secret = secrets.token_bytes(16)
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
