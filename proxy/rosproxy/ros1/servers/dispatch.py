"""XML-RPC or TCPROS: what a client speaks is decided here, once for each connection.

One port stands for all of a node: its slave API (XML-RPC over HTTP) and its topics and services
(TCPROS). In both protocols the client speaks first, and four bytes tell them apart: letters are an
HTTP method, anything else the length of a connection header. They are only peeked at, so that the
socket goes on untouched.
"""

import socket
from collections.abc import Awaitable, Callable
from functools import partial

from rosproxy.net.sockets import peek
from rosproxy.ros1.protocol.tcpros import speaks_http
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.servers.tcpros import TcprosServer
from rosproxy.ros1.servers.xmlrpc_server import XmlRpcServer


async def dispatch(
    conn: socket.socket,
    http: XmlRpcServer,
    relay: Callable[[socket.socket], Awaitable[None]] | None = None,
) -> None:
    """Hand a connection to whom its first bytes are for; without ``relay`` all is HTTP.

    One that ends before it has said anything is closed. Raises TimeoutError, OSError.
    """
    first = await peek(conn, 4)
    if relay is None and first:
        await http.serve(conn)
    elif len(first) < 4 or relay is None:
        conn.close()
    elif speaks_http(first):
        await http.serve(conn)
    else:
        await relay(conn)


class NodeServer:
    """What answers at a node's leases: its slave API and its TCPROS port."""

    def __init__(self, slave: XmlRpcServer, tcpros: TcprosServer) -> None:
        self._slave, self._tcpros = slave, tcpros

    async def serve(self, endpoint: Endpoint, conn: socket.socket, peer: str) -> None:
        """Serve a connection to one of an endpoint's ports. Raises TimeoutError, OSError."""
        await dispatch(conn, self._slave, partial(self._tcpros.serve, endpoint, peer))

    def end_calls(self, port: int) -> None:
        """Let the XML-RPC connections of a port end, which refuses from now on."""
        self._slave.close_port(port)
