"""XML-RPC as ROS speaks it: a threaded server and a client that keep to the boundary."""

from __future__ import annotations

import http.client
import socket
import threading
import urllib.parse
import xmlrpc.client
from collections.abc import Callable
from socketserver import ThreadingMixIn
from typing import Any
from xmlrpc.server import SimpleXMLRPCRequestHandler, SimpleXMLRPCServer

from rosproxy.demo.boundary import Boundary

CALL_ERRORS = (OSError, http.client.HTTPException, xmlrpc.client.Error)
"""What a call to another node may raise: it is gone, out of reach, or talks nonsense."""

Dispatch = Callable[[str, tuple[Any, ...]], Any]


class RosError(Exception):
    """A call that was answered with another ROS status than 1 (success)."""


class _Handler(SimpleXMLRPCRequestHandler):
    """Keeps connections alive and answers `/` and `/RPC2`, as ROS's own servers do."""

    protocol_version = "HTTP/1.1"
    rpc_paths = ("/", "/RPC2")
    disable_nagle_algorithm = True
    # One segment for header and body: unbuffered, they would go out as several.
    wbufsize = -1

    def log_message(self, *_: object) -> None:
        """Keep malformed requests off the terminal: the table is there."""


class RpcServer(ThreadingMixIn, SimpleXMLRPCServer):
    """An XML-RPC server, one thread for each connection, on a free port of one address."""

    # `close` ends every connection, so waiting for the threads is short and leaks nothing.
    daemon_threads = False
    block_on_close = True

    def __init__(self, address: str, dispatch: Dispatch, boundary: Boundary) -> None:
        super().__init__((address, 0), _Handler, logRequests=False, allow_none=False)
        self._boundary = boundary
        self._open: set[Any] = set()
        self._open_lock = threading.Lock()
        self.register_instance(_Instance(dispatch))
        self.register_multicall_functions()
        self._loop = threading.Thread(target=self.serve_forever, args=(0.05,), daemon=True)

    @property
    def port(self) -> int:
        """The port that the server listens on."""
        return int(self.server_address[1])

    def start(self) -> None:
        """Serve in the background until `close`."""
        self._loop.start()

    def close(self) -> None:
        """Stop listening, end every open connection, and wait for their threads."""
        self.shutdown()
        self._loop.join()
        with self._open_lock:
            for connection in self._open:
                end_connection(connection)
        self.server_close()

    def verify_request(self, request: Any, client_address: Any) -> bool:
        """Turn away peers that the boundary doesn't let in."""
        return self._boundary.admits(str(client_address[0]))

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serve one connection, known to `close` while it lasts."""
        with self._open_lock:
            self._open.add(request)
        try:
            super().process_request_thread(request, client_address)
        finally:
            with self._open_lock:
                self._open.discard(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing about peers that vanish in the middle of a call: that is daily life."""


class _Instance:
    """What `register_instance` wants: an object with `_dispatch`."""

    def __init__(self, dispatch: Dispatch) -> None:
        self._dispatch = dispatch


class _Transport(xmlrpc.client.Transport):
    """A client transport with a time-out that leaves from the address the boundary says."""

    def __init__(self, boundary: Boundary, timeout: float) -> None:
        super().__init__()
        self._boundary = boundary
        self._timeout = timeout

    def make_connection(self, host: Any) -> http.client.HTTPConnection:
        name = str(host).rpartition(":")[0] or str(host)
        source = self._boundary.source_for(name)
        connection = http.client.HTTPConnection(
            str(host), timeout=self._timeout, source_address=source
        )
        # The base class closes what it finds here.
        self._connection = (host, connection)
        return connection


def end_connection(connection: socket.socket) -> None:
    """Shut a socket down in both directions, so that whoever reads from it wakes up."""
    try:
        connection.shutdown(socket.SHUT_RDWR)
    except OSError:
        return


def split_address(uri: str) -> tuple[str, int]:
    """Return host and port of a `http://` or `rosrpc://` URI; raises RosError when it lacks one."""
    parts = urllib.parse.urlsplit(uri)
    if not parts.hostname or not parts.port:
        raise RosError(f"no address in {uri!r}")
    return parts.hostname, parts.port


def call(boundary: Boundary, uri: str, method: str, *args: Any, timeout: float = 3.0) -> Any:
    """Make one XML-RPC call and return its plain result; raises one of CALL_ERRORS."""
    transport = _Transport(boundary, timeout)
    with xmlrpc.client.ServerProxy(uri, transport=transport) as server:
        return getattr(server, method)(*args)


def ask(boundary: Boundary, uri: str, method: str, *args: Any, timeout: float = 3.0) -> Any:
    """Make a ROS call and return its value; raises RosError, or one of CALL_ERRORS."""
    code, message, value = call(boundary, uri, method, *args, timeout=timeout)
    if code != 1:
        raise RosError(f"{method}: {message}")
    return value
