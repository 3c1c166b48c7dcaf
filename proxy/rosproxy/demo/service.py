"""A service, served and called over TCPROS: adding two integers."""

from __future__ import annotations

import socket

from rosproxy.demo import wire
from rosproxy.demo.boundary import Boundary
from rosproxy.demo.rpc import ask, split_address

KIND = wire.ADD_TWO_INTS
OK = b"\x01"
TIMEOUT = 2.0


class Service:
    """One service of one node; TCPROS connections arrive through `serve`."""

    def __init__(self, caller_id: str, name: str) -> None:
        self.name = name
        self.answered = 0
        self._caller_id = caller_id

    def serve(self, connection: socket.socket, header: dict[str, str]) -> None:
        """Answer one call, or all of a persistent client; raises ProtocolError or OSError."""
        if not KIND.accepts(header):
            raise wire.ProtocolError(f"request does not match the type of [{self.name}]")
        wire.send_header(connection, KIND.fields() | {"callerid": self._caller_id})
        if header.get("probe") == "1":
            return
        self._answer(connection)
        while header.get("persistent") == "1":
            self._answer(connection)

    def _answer(self, connection: socket.socket) -> None:
        reply = wire.add_operands(wire.receive_block(connection))
        self.answered += 1
        connection.sendall(OK + reply)


def add(boundary: Boundary, master: str, caller_id: str, service: str, a: int, b: int) -> int:
    """Look `service` up at the master, call it, and return the sum.

    Raises RosError, ProtocolError, or one of CALL_ERRORS.
    """
    host, port = split_address(ask(boundary, master, "lookupService", caller_id, service))
    with boundary.connect(host, port, TIMEOUT) as connection:
        wire.send_header(connection, KIND.fields() | {"callerid": caller_id, "service": service})
        wire.receive_header(connection)
        connection.sendall(wire.pack_operands(a, b))
        success = wire.receive(connection, 1) == OK
        body = wire.receive_block(connection)
    if not success:
        raise wire.ProtocolError(body.decode("utf-8", "replace"))
    return wire.unpack_sum(body)
