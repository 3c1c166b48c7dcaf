"""Tries to connect to a router outside with which the hub has no session."""

from collections.abc import Collection

from rosproxy.net import sockets
from rosproxy.net.addresses import HostPort
from rosproxy.zenoh.links import LinkFault


async def try_link(addresses: Collection[str], port: int) -> LinkFault:
    """Return why the hub has no session with a router, as far as a TCP connection shows.

    Without addresses: UNRESOLVABLE. If an address accepts: NO_SESSION. Otherwise the fault of the
    last address.
    """
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
