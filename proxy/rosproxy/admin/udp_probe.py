"""Does what is sent to the advertised host by UDP come in? Tried by the proxy itself.

In ROS 2 nobody outside can be asked to try, and where NAT has no way back (no hairpin) the try
fails although outside gets through. So a success proves much, and a failure little.
"""

import asyncio
import contextlib
import socket

from rosproxy.net.addresses import HostPort

ATTEMPTS, WITHIN = 3, 1.0
"""UDP may lose some: how many are sent, and the seconds in which each may come back."""


async def try_udp(target: HostPort, secret: bytes, heard: asyncio.Event) -> str:
    """Send a secret to an IP address and port: ``ok`` if ``heard`` is set then, else why not."""
    family = socket.AF_INET6 if ":" in target.host else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM) as sock:
        for _ in range(ATTEMPTS):
            try:
                sock.sendto(secret, (target.host, target.port))
            except OSError:
                return "unreachable"
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(WITHIN):
                    await heard.wait()
                return "ok"
    return "silent"
