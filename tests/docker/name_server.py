"""A name server that knows a few names, like that of a home or company network."""

import contextlib
import socket
import struct
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

_ADDRESS = 1


@contextmanager
def name_server(bind: str, names: Mapping[str, str]) -> Iterator[None]:
    """Answer on port 53 of an address; other names don't exist."""
    done = threading.Event()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind((bind, 53))
        server.settimeout(0.1)
        thread = threading.Thread(target=_serve, args=(server, names, done))
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()


def _serve(server: socket.socket, names: Mapping[str, str], done: threading.Event) -> None:
    while not done.is_set():
        with contextlib.suppress(TimeoutError):
            query, peer = server.recvfrom(512)
            server.sendto(reply(query, names), peer)


def reply(query: bytes, names: Mapping[str, str]) -> bytes:
    """The answer to a query for a name."""
    name, end = question(query)
    kind = struct.unpack(">H", query[end : end + 2])[0]
    address = names.get(name.lower(), "")
    answered = bool(address) and kind == _ADDRESS
    flags = 0x8180 if address else 0x8183
    head = query[:2] + struct.pack(">5H", flags, 1, int(answered), 0, 0)
    answer = struct.pack(">3HIH", 0xC00C, _ADDRESS, 1, 1, 4) + socket.inet_aton(address or "0")
    return head + query[12 : end + 4] + (answer if answered else b"")


def question(query: bytes) -> tuple[str, int]:
    """The name in a query, and the offset of its end."""
    labels = []
    at = 12
    while length := query[at]:
        labels.append(query[at + 1 : at + 1 + length].decode("ascii", "replace"))
        at += 1 + length
    return ".".join(labels), at + 1
