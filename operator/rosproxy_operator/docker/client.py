"""The Docker engine as far as the operator needs it: a thin layer over the SDK's APIClient.

A socket proxy in front of the engine has to let exactly these through, with ``/v1.41`` (whatever
version both sides know) before each path but the first::

    GET /version
    GET /events
    GET /containers/json
    GET /containers/[^/]+/json
    GET /networks
    GET /images/.+/json
    POST /networks/create
    POST /networks/[^/]+/connect
    POST /networks/[^/]+/disconnect
    POST /containers/create
    POST /containers/[^/]+/start
    POST /containers/[^/]+/restart
    POST /containers/[^/]+/stop
    POST /containers/[^/]+/unpause
    POST /containers/[^/]+/rename
    DELETE /containers/[^/]+

``rosproxy-operator docker status`` and ``plan`` need the GETs alone.
"""

import contextlib
import os
import socket
from collections.abc import Iterator, Mapping
from typing import Any

import requests
from docker.errors import APIError, DockerException, TLSParameterError
from docker.utils import kwargs_from_env

import docker
from rosproxy_operator.docker.errors import Gone, Unavailable, refusal, unreachable

Json = dict[str, Any]
DEFAULT_SOCKET = "unix:///var/run/docker.sock"
READ_TIMEOUT = 20
"""Seconds that the engine has to answer a question."""
WRITE_TIMEOUT = 300
"""Seconds that it has to do something: publishing or freeing 1000 ports takes it a minute."""
STOP_TIMEOUT = 2
"""Seconds that a process has to end before it is killed."""


class DockerClient:
    """The engine that DOCKER_HOST names, or the one of this machine. Can be used by many threads.

    Every method raises EngineError: Unavailable if the engine can't be reached, Gone, Conflict or
    PortTaken where it refuses for that reason.
    """

    def __init__(self) -> None:
        self.url = os.environ.get("DOCKER_HOST") or DEFAULT_SOCKET
        self._version: str | None = None
        self._idle: list[Any] = []

    def containers(self) -> list[Json]:
        """All containers, whatever their state, as the engine lists them."""
        found: list[Json] = self._ask("containers", all=True)
        return found

    def container(self, name: str) -> Json:
        """Everything about a container, by id or name."""
        found: Json = self._ask("inspect_container", name)
        return found

    def networks(self) -> list[Json]:
        """All networks."""
        found: list[Json] = self._ask("networks")
        return found

    def image_id(self, image: str) -> str:
        """The id of an image, empty if the host does not have it."""
        try:
            return str(self._ask("inspect_image", image)["Id"])
        except Gone:
            return ""

    def events(self, filters: Mapping[str, list[str]]) -> Iterator[Json]:
        """What happens from now on; ends when the connection does.

        The connection stands when this returns, so that whatever is listed after that has either
        happened before or is going to be told.
        """
        with self._translated():
            client = self._connect()
            stream: Iterator[Json] = client.events(filters=dict(filters), decode=True)
        return self._each(stream)

    def create_network(self, name: str, labels: Mapping[str, str]) -> None:
        """Create a bridge network."""
        self._do("create_network", name, driver="bridge", labels=dict(labels), check_duplicate=True)

    def create_container(self, name: str, config: Mapping[str, Any]) -> None:
        """Create a container from the engine's own description of one."""
        self._do("create_container_from_config", dict(config), name)

    def start(self, name: str) -> None:
        """Start a container; one that runs is left alone."""
        self._do("start", name)

    def restart(self, name: str) -> None:
        """End a container's process and start it again, or only start it."""
        self._do("restart", name, timeout=STOP_TIMEOUT)

    def stop(self, name: str) -> None:
        """End a container's process; one that does not run is left alone."""
        self._do("stop", name, timeout=STOP_TIMEOUT)

    def unpause(self, name: str) -> None:
        """Resume a container."""
        self._do("unpause", name)

    def rename(self, name: str, to: str) -> None:
        """Rename a container."""
        self._do("rename", name, to)

    def remove(self, name: str) -> None:
        """Kill and remove a container."""
        self._do("remove_container", name, force=True)

    def connect(self, name: str, network: str, aliases: tuple[str, ...]) -> None:
        """Connect a container to a network under these names."""
        self._do("connect_container_to_network", name, network, aliases=list(aliases))

    def disconnect(self, name: str, network: str) -> None:
        """Disconnect a container from a network, also from one that does not exist any more."""
        self._do("disconnect_container_from_network", name, network, force=True)

    def _ask(self, method: str, *arguments: Any, **more: Any) -> Any:
        return self._call(READ_TIMEOUT, method, *arguments, **more)

    def _do(self, method: str, *arguments: Any, **more: Any) -> None:
        self._call(WRITE_TIMEOUT, method, *arguments, **more)

    def _call(self, within: int, method: str, *arguments: Any, **more: Any) -> Any:
        """Call the SDK by a client that nobody else uses now: they are not meant to be shared."""
        with self._translated():
            client = self._idle.pop() if self._idle else self._connect()
            client.timeout = within
            try:
                result = getattr(client, method)(*arguments, **more)
            except APIError:
                self._idle.append(client)
                raise
            self._idle.append(client)
            return result

    def _connect(self) -> Any:
        self._knock()
        client = docker.APIClient(
            version=self._version or "auto", timeout=READ_TIMEOUT, **kwargs_from_env()
        )
        self._version = client.api_version
        return client

    def _knock(self) -> None:
        """Raise OSError if nobody listens at the socket; the SDK would leave one open each time."""
        if self.url.startswith("unix://"):
            with socket.socket(socket.AF_UNIX) as probe:
                probe.settimeout(READ_TIMEOUT)
                probe.connect(self.url.removeprefix("unix://"))

    def _each(self, stream: Iterator[Json]) -> Iterator[Json]:
        with self._translated():
            yield from stream

    def _forget(self) -> None:
        """Ask for the version anew: the next engine behind this address may be another one."""
        self._version = None
        self._idle.clear()

    @contextlib.contextmanager
    def _translated(self) -> Iterator[None]:
        """Turn what the SDK raises into EngineError."""
        try:
            yield
        except APIError as error:
            request = getattr(error.response, "request", None)
            what = f"{request.method} {request.path_url.partition('?')[0]}" if request else ""
            raise refusal(error.status_code or 0, str(error.explanation or error), what) from error
        except (DockerException, TLSParameterError, requests.RequestException, OSError) as error:
            self._forget()
            raise unreachable(self.url, error) from error
        except (ValueError, KeyError, TypeError) as error:
            raise Unavailable(f"what answers at {self.url} is no Docker engine: {error}") from error
