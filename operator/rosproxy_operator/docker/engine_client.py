"""The Docker engine as far as the operator needs it: a thin layer over the SDK's APIClient.

docs/reference/permissions.md lists what a socket proxy in front of the engine has to let through,
with ``/v1.41`` (whatever version both sides know) before each path but the first; the GETs are
enough for ``rosproxy-operator docker status`` and ``plan``.
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
READ_TIMEOUT = 20
"""Seconds that the engine has to answer a question."""
WRITE_TIMEOUT = 300
"""Seconds that it has to do something: publishing or freeing 1000 ports takes it a minute."""
RUN_TIMEOUT = 60
"""Seconds for a command in a container: the doctor tries what may not answer."""
FILTERS = {
    "type": ["container", "network", "image"],
    "event": [
        *("create", "start", "die", "destroy", "pause", "unpause", "rename"),
        *("connect", "disconnect"),
        *("tag", "untag", "pull", "load", "import", "delete"),
    ],
}
"""Events that may change a plan: not the frequent ones of health checks and ``docker exec``."""
PAUSES = (0.2, 0.5, 1.0, 2.0, 5.0)
"""Seconds between attempts to listen to events again; the last one is repeated."""


class DockerClient:
    """The engine that DOCKER_HOST names, or the one of this machine. Can be used by many threads.

    Every method raises EngineError: Unavailable if the engine can't be reached, NoSuchObject,
    Conflict or PortTaken where it refuses for that reason.
    """

    def __init__(self) -> None:
        self.url = os.environ.get("DOCKER_HOST") or DEFAULT_SOCKET
        self._version: str | None = None
        self._last_version = (0, 0)
        self._idle: list[Any] = []

    @property
    def deletes_udp_entries(self) -> bool:
        """Whether the engine deletes conntrack entries for the UDP ports that it publishes.

        Docker does since 23.0, whose API is 1.42 (github.com/moby/moby/pull/44742).
        """
        return self._last_version >= (1, 42)

    def containers(self) -> list[Json]:
        """All containers, whatever their state, as the engine lists them."""
        return list(self._call(READ_TIMEOUT, "containers", all=True))

    def container(self, name: str) -> Json:
        """Everything about a container, by id or name."""
        inspected: Json = self._call(READ_TIMEOUT, "inspect_container", name)
        return inspected

    def networks(self) -> list[Json]:
        """All networks."""
        return list(self._call(READ_TIMEOUT, "networks"))

    def image_id(self, image: str) -> str:
        """The id of an image, empty if the host does not have it."""
        try:
            return str(self._call(READ_TIMEOUT, "inspect_image", image)["Id"])
        except NoSuchObject:
            return ""

    def run(self, container: str, *command: str) -> bytes:
        """What a command prints in a running container, to its end."""
        instance = self._call(READ_TIMEOUT, "exec_create", container, list(command), stderr=False)
        output: bytes = self._call(RUN_TIMEOUT, "exec_start", instance["Id"])
        return output

    def events(self) -> Iterator[Json]:
        """The events from now on that may change a plan; ends when the connection does.

        The connection stands when this returns, so that what is listed later has either happened
        before or is going to be an event.
        """
        with self._translated():
            # A client for the stream alone, which is read for good. The SDK sets no time-out for
            # it, so that an engine with nothing to tell is no failure.
            stream = self._connect().events(filters=FILTERS, decode=True)
        return self._read_events(stream)

    def do(self, method: str, *arguments: Any, **keywords: Any) -> None:
        """Let the engine do something, by a method of the SDK's APIClient."""
        self._call(WRITE_TIMEOUT, method, *arguments, **keywords)

    def _call(self, within: int, method: str, *arguments: Any, **keywords: Any) -> Any:
        """Call the SDK with a client that no other thread uses now: clients are not shareable."""
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
            # Where nobody listens, the SDK would leave a socket open each time.
            with socket.socket(socket.AF_UNIX) as probe:
                probe.settimeout(READ_TIMEOUT)
                probe.connect(self.url.removeprefix("unix://"))
        version = self._version or "auto"
        client = docker.APIClient(version=version, timeout=READ_TIMEOUT, **kwargs_from_env())
        self._version = client.api_version
        major, _, minor = self._version.partition(".")
        self._last_version = (int(major), int(minor))
        return client

    def _read_events(self, stream: Iterator[Json]) -> Iterator[Json]:
        with self._translated():
            yield from stream

    @contextlib.contextmanager
    def _translated(self) -> Iterator[None]:
        """Turn what the SDK raises into EngineError."""
        try:
            yield
        except APIError as error:
            request = getattr(error.response, "request", None)
            line = f"{request.method} {request.path_url.partition('?')[0]}" if request else ""
            raise refusal(error.status_code or 0, str(error.explanation or error), line) from error
        except (DockerException, TLSParameterError, requests.RequestException, OSError) as error:
            self._version = None  # the next engine behind this address may be another one
            self._idle.clear()
            raise unreachable(self.url, error) from error
        except (ValueError, KeyError, TypeError) as error:
            text = f"the program that answers at {self.url} is not a Docker engine: {error}"
            raise Unavailable(text) from error


def listen(engine: DockerClient, tell: Callable[[Json | None], None]) -> None:
    """Listen to the engine for good, in a thread of its own. Needs a running event loop.

    ``tell`` is called in the event loop, with each event of FILTERS, and with None after each
    connect: the engine is there, and what happened before that was missed.
    """
    loop = asyncio.get_running_loop()

    def work() -> None:
        failures = 0
        while not loop.is_closed():
            # Looks report errors of the engine; the event loop may have been closed meanwhile.
            with contextlib.suppress(EngineError, RuntimeError):
                events = engine.events()
                failures = 0
                loop.call_soon_threadsafe(tell, None)
                for event in events:
                    loop.call_soon_threadsafe(tell, event)
            time.sleep(PAUSES[min(failures, len(PAUSES) - 1)])
            failures += 1

    threading.Thread(target=work, daemon=True, name="events").start()
