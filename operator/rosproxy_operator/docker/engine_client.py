"""The client of the Docker engine: a thin layer over the SDK's APIClient.

docs/reference/permissions.md lists the calls that a socket proxy in front of the engine must allow.
``rosproxy-operator docker status`` and ``plan`` need only the GETs.
"""

import asyncio
import contextlib
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import requests
from docker.errors import APIError, DockerException, TLSParameterError
from docker.utils import kwargs_from_env

import docker
from rosproxy_operator.docker.errors import (
    EngineError,
    NoSuchObject,
    Unavailable,
    refusal,
    unreachable,
)

Json = dict[str, Any]
DEFAULT_SOCKET = "unix:///var/run/docker.sock"
READ_TIMEOUT_S = 20
"""Seconds in which the engine must answer a read call."""
WRITE_TIMEOUT_S = 300
"""Seconds for a call that changes something: 1000 ports to publish or free take a minute."""
RUN_TIMEOUT_S = 60
"""Seconds for a command in a container: the doctor waits for nodes that do not answer."""
EVENT_FILTERS = {
    "type": ["container", "network", "image"],
    "event": [
        *("create", "start", "die", "destroy", "pause", "unpause", "rename"),
        *("connect", "disconnect"),
        *("tag", "untag", "pull", "load", "import", "delete"),
    ],
}
"""The events that may change a plan. Health checks and ``docker exec`` cause many other events."""
LISTEN_RETRY_PAUSES_S = (0.2, 0.5, 1.0, 2.0, 5.0)
"""Seconds before each new attempt to listen to events; the last value repeats."""


class DockerClient:
    """The client of the engine in DOCKER_HOST, or else of this machine. Safe for many threads.

    Every method raises EngineError. Subclasses: Unavailable if the client can't reach the engine;
    NoSuchObject, Conflict and PortTaken if the engine refuses the call.
    """

    def __init__(self) -> None:
        self.url = os.environ.get("DOCKER_HOST") or DEFAULT_SOCKET
        self._version: str | None = None
        self._last_version = (0, 0)
        self._idle: list[Any] = []

    @property
    def deletes_udp_entries(self) -> bool:
        """Whether the engine deletes conntrack entries for published UDP ports.

        Docker does so since 23.0, which has API 1.42 (github.com/moby/moby/pull/44742). False until
        the client has connected.
        """
        return self._last_version >= (1, 42)

    def containers(self) -> list[Json]:
        """List all containers, in all states."""
        return list(self._call(READ_TIMEOUT_S, "containers", all=True))

    def container(self, name: str) -> Json:
        """Inspect a container, by id or name."""
        inspected: Json = self._call(READ_TIMEOUT_S, "inspect_container", name)
        return inspected

    def networks(self) -> list[Json]:
        """List all networks."""
        return list(self._call(READ_TIMEOUT_S, "networks"))

    def image_id(self, image: str) -> str:
        """Return the id of an image; empty if the host does not have the image."""
        try:
            return str(self._call(READ_TIMEOUT_S, "inspect_image", image)["Id"])
        except NoSuchObject:
            return ""

    def run(self, container: str, *command: str) -> bytes:
        """Run a command in a running container until its end. Return the stdout."""
        instance = self._call(READ_TIMEOUT_S, "exec_create", container, list(command), stderr=False)
        output: bytes = self._call(RUN_TIMEOUT_S, "exec_start", instance["Id"])
        return output

    def events(self) -> Iterator[Json]:
        """Connect, and return the events of EVENT_FILTERS from now on.

        The iterator ends with the connection. When this method returns, the connection is open. A
        list requested from now on shows all changes before the connection opened. Each change since
        then causes an event.
        """
        with self._translated():
            # The stream has a client of its own, because reading the stream does not end. The SDK
            # sets no time-out for the stream, so an engine without events is no failure.
            stream = self._connect().events(filters=EVENT_FILTERS, decode=True)
        return self._read_events(stream)

    def do(self, method: str, *arguments: Any, **keywords: Any) -> None:
        """Call a method of the SDK's APIClient that changes something."""
        self._call(WRITE_TIMEOUT_S, method, *arguments, **keywords)

    def _call(self, within: int, method: str, *arguments: Any, **keywords: Any) -> Any:
        """Call a method of an idle SDK client: threads must not share a client.

        ``within`` is the time-out in seconds.
        """
        with self._translated():
            try:
                client = self._idle.pop()
            except IndexError:
                client = self._connect()
            client.timeout = within
            try:
                return getattr(client, method)(*arguments, **keywords)
            finally:
                self._idle.append(client)

    def _connect(self) -> Any:
        if self.url.startswith("unix://"):
            # Without a listener, the SDK would leave a socket open after each attempt.
            with socket.socket(socket.AF_UNIX) as probe:
                probe.settimeout(READ_TIMEOUT_S)
                probe.connect(self.url.removeprefix("unix://"))
        version = self._version or "auto"
        client = docker.APIClient(version=version, timeout=READ_TIMEOUT_S, **kwargs_from_env())
        self._version = client.api_version
        major, _, minor = self._version.partition(".")
        self._last_version = (int(major), int(minor))
        return client

    def _read_events(self, stream: Iterator[Json]) -> Iterator[Json]:
        with self._translated():
            yield from stream

    @contextlib.contextmanager
    def _translated(self) -> Iterator[None]:
        """Turn exceptions of the SDK into EngineError."""
        try:
            yield
        except APIError as error:
            request = getattr(error.response, "request", None)
            line = f"{request.method} {request.path_url.partition('?')[0]}" if request else ""
            raise refusal(error.status_code or 0, str(error.explanation or error), line) from error
        except (DockerException, TLSParameterError, requests.RequestException, OSError) as error:
            self._version = None  # the next engine may have another API version
            self._idle.clear()
            raise unreachable(self.url, error) from error
        except (ValueError, KeyError, TypeError) as error:
            text = f"the program that answers at {self.url} is not a Docker engine: {error}"
            raise Unavailable(text) from error


def listen(engine: DockerClient, tell: Callable[[Json | None], None]) -> None:
    """Start a thread that listens to the engine's events. Needs a running event loop.

    The event loop calls ``tell`` with each event of EVENT_FILTERS. After each connect, the event
    loop first calls ``tell(None)``: the engine answers, and earlier events may be missing.
    """
    loop = asyncio.get_running_loop()

    def work() -> None:
        failures = 0
        while not loop.is_closed():
            # EngineError: the looks report this error. RuntimeError: the event loop is closed.
            with contextlib.suppress(EngineError, RuntimeError):
                events = engine.events()
                failures = 0
                loop.call_soon_threadsafe(tell, None)
                for event in events:
                    loop.call_soon_threadsafe(tell, event)
            time.sleep(LISTEN_RETRY_PAUSES_S[min(failures, len(LISTEN_RETRY_PAUSES_S) - 1)])
            failures += 1

    threading.Thread(target=work, daemon=True, name="events").start()
