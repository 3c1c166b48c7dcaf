"""What can go wrong with the engine, and what to do about it, in one line."""

import errno
import os
import re
from collections.abc import Iterator

_PORT_TAKEN = re.compile(
    r"port is already allocated|address already in use|ports are not available"
)
_PORT = re.compile(r"(?:[0-9.]+|\[[0-9A-Fa-f:]*\]|::):([0-9]{1,5})\b")
_FOREIGN_ADDRESS = re.compile(r"(\S+): bind: cannot assign requested address")
_IDS = re.compile(r"\b[0-9a-f]{64}\b")


class EngineError(Exception):
    """The engine did not do what it was asked; the message is one line."""


class Unavailable(EngineError):
    """The engine can't be reached, or does not answer."""


class Conflict(EngineError):
    """The name is taken, or somebody else is at it."""


class Gone(EngineError):
    """An object does not exist. ``kind`` is ``container``, ``network`` or ``image``."""

    def __init__(self, message: str) -> None:
        super().__init__(message)
        lowered = message.lower()
        self.kind = next((k for k in ("network", "image") if k in lowered), "container")


class PortTaken(EngineError):
    """A port to publish is held by another program or container; which one is not always told."""

    def __init__(self, message: str, port: int | None) -> None:
        super().__init__(message)
        self.port = port


def refusal(status: int, text: str, request: str) -> EngineError:
    """The error for what an engine (or a proxy in front of it) answered to a request."""
    message = _IDS.sub(lambda found: found[0][:12], " ".join(text.split()))
    if status == 404 and "page not found" not in message:
        return Gone(message)
    if status == 409:
        return Conflict(message)
    if _PORT_TAKEN.search(message):
        return PortTaken(message, _port_in(message))
    if foreign := _FOREIGN_ADDRESS.search(message):
        text = f"--publish-address: {foreign[1].rpartition(':')[0]} is not an address of this host"
        return EngineError(text)
    if status in (401, 403, 404, 405) and not _is_engines(message):
        return EngineError(
            f"{request} is not allowed (HTTP {status}: {message[:100]}); "
            "let it through the proxy in front of the engine's socket"
        )
    return EngineError(message)


def unreachable(url: str, error: BaseException) -> Unavailable:
    """The error for an engine at ``url`` that can't be asked."""
    path = url.removeprefix("unix://")
    number = next((e.errno for e in _chain(error) if isinstance(e, OSError) and e.errno), None)
    if number in (errno.EACCES, errno.EPERM):
        return Unavailable(
            f"no permission to use the Docker engine's socket {path}: run as root or with "
            f"the socket's group (in a container: --group-add {_group(path)})"
        )
    if number == errno.ENOENT:
        return Unavailable(
            f"there is no Docker engine's socket {path}: start the engine, or in a container "
            f"mount it (-v {path}:{path}), or name the engine by DOCKER_HOST"
        )
    if number == errno.ECONNREFUSED:
        return Unavailable(f"no Docker engine answers at {url}: is it running?")
    deepest = [*_chain(error)][-1]
    return Unavailable(f"the Docker engine at {url} can't be asked: {str(deepest)[:200]}")


def _port_in(message: str) -> int | None:
    """The port in the message; not in the endpoint's name before it, which may hold anything."""
    found = [int(port) for port in _PORT.findall(message.rpartition("endpoint ")[2])]
    return next((port for port in found if port), None)


def _is_engines(message: str) -> bool:
    """Whether the engine itself says so: it has its reasons to answer 403."""
    return re.search(r"endpoint|network|container", message) is not None


def _group(path: str) -> str:
    try:
        return str(os.stat(path).st_gid)
    except OSError:
        return "GID"


def _chain(error: BaseException) -> Iterator[BaseException]:
    """The error, what it carries and what caused it; requests wraps OSErrors in two layers."""
    yield error
    inner = [a for a in error.args if isinstance(a, BaseException)]
    inner += [e for e in (getattr(error, "reason", None),) if isinstance(e, BaseException)]
    cause = error.__cause__ or error.__context__
    for each in dict.fromkeys([*inner, *([cause] if cause else [])]):
        yield from _chain(each)
