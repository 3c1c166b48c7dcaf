"""Errors of the Docker engine. Each message is a single line."""

import errno
import os
import re

_PORT_TAKEN = re.compile(
    r"port is already allocated|address already in use|ports are not available"
)
_PORT = re.compile(r"(?:[0-9.]+|\[[0-9A-Fa-f:]*\]|::):([0-9]{1,5})\b")
_FOREIGN_ADDRESS = re.compile(r"(\S+): bind: cannot assign requested address")
_MISSING_DIRECTORY = re.compile(r"bind source path does not exist: (\S.*)")
_IDS = re.compile(r"\b[0-9a-f]{64}\b")
_ENGINE_WORDS = re.compile(r"endpoint|network|container")
"""Words in the engine's own refusals. A proxy in front of the engine does not write these words."""


class EngineError(Exception):
    """The engine did not carry out a call."""


class Unavailable(EngineError):
    """The operator can't reach the engine, or the engine does not answer."""


class FormerSocket(Unavailable):
    """The mounted socket file belongs to an engine process that has ended."""


class Conflict(EngineError):
    """HTTP 409: the name is in use, or another call is changing the same object."""


class NoSuchObject(EngineError):
    """A container, network or image does not exist."""


class PortTaken(EngineError):
    """Another program or container holds a port to publish. ``port`` is None if it is unknown."""

    def __init__(self, message: str, port: int | None) -> None:
        super().__init__(message)
        self.port = port


def refusal(status: int, text: str, request: str) -> EngineError:
    """Return the error for an HTTP ``status`` that refuses a ``request`` (method and path).

    The status and the ``text`` come from the engine, or from a proxy in front of its socket.
    """
    message = _IDS.sub(lambda match: match[0][:12], " ".join(text.split()))
    # "page not found" is no missing object: the engine does not know the path of the request
    # (moby: daemon/server/server.go, CreateMux).
    if status == 404 and "page not found" not in message:
        return NoSuchObject(message)
    if status == 409:
        return Conflict(message)
    if _PORT_TAKEN.search(message):
        # The endpoint's name may contain anything. The ports come after the name.
        ports = map(int, _PORT.findall(message.rpartition("endpoint ")[2]))
        # Docker Desktop names port 0 as well: "exposing port TCP 0.0.0.0:80 -> 127.0.0.1:0".
        return PortTaken(message, next(filter(None, ports), None))
    if foreign := _FOREIGN_ADDRESS.search(message):
        message = (
            f"--publish-address: {foreign[1].rpartition(':')[0]} is not an address of this host"
        )
    elif missing := _MISSING_DIRECTORY.search(message):  # the only mount of a proxy
        message = (
            f"--zenoh-link-certificates: {missing[1]} does not exist on the Docker host. Create "
            "the directory, with tls.crt, tls.key and ca.crt"
        )
    elif status in (401, 403, 404, 405) and not _ENGINE_WORDS.search(message):
        message = (
            f"{request} is refused (HTTP {status}: {message[:100]}). If a proxy stands in front of "
            "the engine's socket, allow this request there"
        )
    return EngineError(message)


def unreachable(url: str, error: BaseException) -> Unavailable:
    """Return the error for an engine at ``url`` that the operator can't reach."""
    path = url.removeprefix("unix://")
    chain = [error]  # requests and urllib3 wrap an OSError in two layers, the SDK in a third
    while cause := chain[-1].__cause__ or chain[-1].__context__:
        chain.append(cause)
    number = next((e.errno for e in chain if isinstance(e, OSError) and e.errno), None)
    if number in (errno.EACCES, errno.EPERM):
        return Unavailable(
            f"no permission to open the socket {path} of the Docker engine. Run as root, or with "
            f"the group of the socket (in a container: --group-add {_group(path)})"
        )
    if number == errno.ENOENT:
        return Unavailable(
            f"the socket {path} of the Docker engine does not exist. Start the engine; in a "
            f"container, mount the socket (-v {path}:{path}); or name the engine in DOCKER_HOST"
        )
    if number == errno.ECONNREFUSED and _is_removed(path):
        return FormerSocket(
            f"the Docker engine was restarted and has a new socket, but this container has the old "
            f"{path}. Restart this container (docker run --restart always does so)"
        )
    if number == errno.ECONNREFUSED:
        return Unavailable(f"no Docker engine answers at {url}. Start the engine")
    return Unavailable(f"a request to the Docker engine at {url} failed: {str(chain[-1])[:200]}")


def _is_removed(path: str) -> bool:
    """Whether the host has removed a file. The mount in this container keeps the old file."""
    try:
        return os.stat(path).st_nlink == 0
    except OSError:
        return False


def _group(path: str) -> str:
    try:
        return str(os.stat(path).st_gid)
    except OSError:
        return "GID"
