"""A tap between a controller and the engine, which acts when the controller changes something."""

import contextlib
import re
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType

ENGINE = "/var/run/docker.sock"


class EngineTap:
    """Relays a controller's requests to the engine, and counts the requests that change something.

    ``arm`` sets an action for such a request: before the engine gets the request, or during its
    execution.
    """

    def __init__(self, directory: Path) -> None:
        self.address = directory / "engine.sock"
        self.writes: list[str] = []
        self._armed: tuple[int, str, Callable[[], object]] | None = None
        self._listener = socket.socket(socket.AF_UNIX)

    @property
    def url(self) -> str:
        return f"unix://{self.address}"

    def arm(self, number: int, when: str, do: Callable[[], object]) -> None:
        self.writes = []
        self._armed = number, when, do

    def __enter__(self) -> "EngineTap":
        self._listener.bind(str(self.address))
        self._listener.listen(50)
        threading.Thread(target=self._accept, daemon=True).start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._listener.close()

    def _accept(self) -> None:
        for client in accepted(self._listener):
            engine = socket.socket(socket.AF_UNIX)
            engine.connect(ENGINE)
            for work, ways in (
                (self._requests, (client, engine)),
                (self._replies, (engine, client)),
            ):
                threading.Thread(target=work, args=ways, daemon=True).start()

    def _requests(self, client: socket.socket, engine: socket.socket) -> None:
        missing = 0
        for data in chunks(client, engine):
            is_write = data.startswith((b"POST ", b"DELETE "))
            if is_write:
                self.writes.append(data.split(b"\r\n", 1)[0].decode())
                self._act("before")
            with contextlib.suppress(OSError):
                engine.sendall(data)
            is_rest = missing > 0
            missing = body_to_come(data) if is_write else 0
            if (is_write or is_rest) and not missing:
                self._act("during")

    def _replies(self, engine: socket.socket, client: socket.socket) -> None:
        # A controller killed in the middle of a reply no longer receives.
        with contextlib.suppress(OSError):
            for data in chunks(engine, client):
                client.sendall(data)

    def _act(self, when: str) -> None:
        if self._armed is not None and self._armed[:2] == (len(self.writes), when):
            self._armed[2]()


def body_to_come(request: bytes) -> int:
    """The number of body bytes that are not in the first packet of a request."""
    head, _, body = request.partition(b"\r\n\r\n")
    match = re.search(rb"\r\ncontent-length: *(\d+)", head, re.IGNORECASE)
    return int(match[1]) - len(body) if match else 0


def accepted(listener: socket.socket) -> Iterator[socket.socket]:
    with contextlib.suppress(OSError):
        while True:
            yield listener.accept()[0]


def chunks(source: socket.socket, target: socket.socket) -> Iterator[bytes]:
    """The data from a side. Closes both sides at the end."""
    with contextlib.suppress(OSError), source, target:
        while data := source.recv(65536):
            yield data
        with contextlib.suppress(OSError):
            target.shutdown(socket.SHUT_RDWR)
