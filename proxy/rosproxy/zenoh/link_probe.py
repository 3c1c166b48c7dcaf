"""Tries to connect to a router outside with which the proxy has no session."""

import asyncio
import socket
import ssl

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.connections import sockets
from rosproxy.zenoh.links import Link, LinkFault, alert_fault, verify_fault

HANDSHAKE_TIMEOUT_S = 5.0
"""Seconds in which a peer must finish the handshake of TLS."""
ALERT_TIMEOUT_S = 2.0
"""Seconds in which a peer refuses the certificate of the proxy, if the peer refuses it."""


async def try_link(link: Link, tls: ssl.SSLContext | None = None) -> LinkFault:
    """Return why there is no session with the peer of a link, as far as a connection shows.

    ``tls``: what proves the proxy to the peer of a link with TLS. Without addresses: UNRESOLVABLE.
    If an address accepts the connection, and with ``tls`` the certificate of the proxy: NO_SESSION.
    Otherwise the fault of the last address.
    """
    fault = LinkFault.UNRESOLVABLE
    for address in link.addresses:
        if link.protocol == "quic":  # Python has no QUIC
            return LinkFault.NO_QUIC_SESSION
        try:
            sock = await sockets.dial(HostPort(address, link.peer.port))
        except TimeoutError:
            fault = LinkFault.SILENT
        except ConnectionRefusedError:
            fault = LinkFault.REFUSED
        except OSError:
            fault = LinkFault.UNREACHABLE
        else:
            if tls is not None:
                return await _try_tls(sock, link.peer.host, tls)
            sock.close()
            return LinkFault.NO_SESSION
    return fault


async def accepts(end: HostPort) -> bool:
    """Whether a program accepts connections at an address."""
    try:
        sock = await sockets.dial(end)
    except OSError:  # also TimeoutError
        return False
    sock.close()
    return True


async def _try_tls(sock: socket.socket, host: str, tls: ssl.SSLContext) -> LinkFault:
    """Try the handshake of TLS on a connection, and close the connection."""
    try:
        reader, writer = await asyncio.open_connection(
            sock=sock, ssl=tls, server_hostname=host, ssl_handshake_timeout=HANDSHAKE_TIMEOUT_S
        )
    except ssl.SSLCertVerificationError as error:
        return verify_fault(error.verify_code)
    except OSError:  # ssl.SSLError is an OSError
        return LinkFault.NO_TLS
    try:
        # In TLS 1.3 the peer checks the certificate of the proxy after the end of the handshake.
        async with asyncio.timeout(ALERT_TIMEOUT_S):
            await reader.read(1)
    except ssl.SSLError as error:
        return alert_fault(error.reason or "")
    except OSError:  # also TimeoutError: the peer waits for the first message of zenoh
        pass
    finally:
        if not writer.is_closing():  # Python 3.11 fails to abort a closed transport
            writer.transport.abort()
    return LinkFault.NO_SESSION
