"""Tries to connect to a router outside with which the hub has no session."""

from collections.abc import Collection

from rosproxy.net import sockets
from rosproxy.net.addresses import HostPort
from rosproxy.zenoh.links import LinkFault


async def try_link(addresses: Collection[str], port: int) -> LinkFault:
    """What keeps the hub from a session with a router, as far as a connection tells."""
    fault = LinkFault.UNRESOLVABLE
    for address in addresses:
        try:
            (await sockets.dial(HostPort(address, port))).close()
        except TimeoutError:
            fault = LinkFault.SILENT
        except ConnectionRefusedError:
            fault = LinkFault.REFUSED
        except OSError:
            fault = LinkFault.UNREACHABLE
        else:
            return LinkFault.NO_SESSION
    return fault
