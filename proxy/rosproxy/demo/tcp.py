"""The TCPROS server of a node: one port for all its topics and services."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable

from rosproxy.demo import wire
from rosproxy.demo.boundary import Boundary
from rosproxy.demo.rpc import end_connection

Serve = Callable[[socket.socket, dict[str, str]], None]
HEADER_TIMEOUT = 5.0


class TcprosServer:
    """Accepts connections on a free port and hands each, with its header, to `serve`.

    A ProtocolError that `serve` raises is told to the peer as ROS does it, in an `error` header.
    """

    def __init__(self, address: str, serve: Serve, boundary: Boundary) -> None:
        self._serve = serve
        self._boundary = boundary
        self._lock = threading.Lock()
        self._open: dict[socket.socket, threading.Thread] = {}
        self._listener = socket.create_server((address, 0))
        self.port = int(self._listener.getsockname()[1])
        self._loop = threading.Thread(target=self._accept_all, daemon=True)

    def start(self) -> None:
        """Serve in the background until `close`."""
        self._loop.start()

    def close(self) -> None:
        """Stop listening, end every connection and wait for their threads."""
        end_connection(self._listener)
        self._listener.close()
        self._loop.join()
        with self._lock:
            threads = list(self._open.values())
            for connection in self._open:
                end_connection(connection)
        for thread in threads:
            thread.join()

    def _accept_all(self) -> None:
        while True:
            try:
                connection, (peer, *_) = self._listener.accept()
            except OSError:
                return
            if self._boundary.admits(str(peer)):
                self._take(connection)
            else:
                connection.close()

    def _take(self, connection: socket.socket) -> None:
        thread = threading.Thread(target=self._handle, args=(connection,), daemon=True)
        with self._lock:
            self._open[connection] = thread
        thread.start()

    def _handle(self, connection: socket.socket) -> None:
        with connection:
            try:
                self._greet(connection)
            except OSError:
                # The peer went away: whoever served it has noticed.
                return
            finally:
                with self._lock:
                    self._open.pop(connection, None)

    def _greet(self, connection: socket.socket) -> None:
        connection.settimeout(HEADER_TIMEOUT)
        try:
            self._serve(connection, wire.receive_header(connection))
        except wire.ProtocolError as problem:
            with contextlib.suppress(OSError):
                wire.send_header(connection, {"error": str(problem)})
