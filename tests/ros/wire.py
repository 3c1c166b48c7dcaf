"""Raw XML-RPC over HTTP, where a test looks at the exact bytes or types."""

from __future__ import annotations

from http.client import HTTPConnection
from typing import Any
from xmlrpc.client import dumps, loads

from tests.ros.topology import Place

TIMEOUT = 5.0


def post(place: Place, address: str, port: int, body: bytes, path: str = "/") -> bytes:
    """POSTs a body from a machine and gives the body of the reply."""
    with place.entered():
        connection = HTTPConnection(address, port, timeout=TIMEOUT)
        try:
            connection.request("POST", path, body, {"Content-Type": "text/xml"})
            reply = connection.getresponse()
            content = reply.read()
        finally:
            connection.close()
    assert reply.status == 200, f"HTTP {reply.status}: {content[:500]!r}"
    return content


def call(place: Place, address: str, port: int, method: str, *arguments: Any) -> Any:
    """Calls a method. Returns the value of the ROS triple, or raises LookupError."""
    reply = post(place, address, port, dumps(arguments, method).encode())
    triple: Any = loads(reply)[0][0]
    code, message, value = triple
    if code != 1:
        raise LookupError(message)
    return value
