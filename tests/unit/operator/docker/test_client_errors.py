"""Refusals of the engine, and the messages for the user."""

import errno
import os
from pathlib import Path

import pytest
import requests
import urllib3

from rosproxy_operator.docker.errors import (
    Conflict,
    EngineError,
    FormerSocket,
    NoSuchObject,
    PortTaken,
    refusal,
    unreachable,
)

ENDPOINT = "driver failed programming external connectivity on endpoint "
NAME = f"x:1234 ({'7f' * 32}): "
SOCKET = "unix:///var/run/docker.sock"


@pytest.mark.parametrize(
    ("text", "port"),
    [
        (f"{ENDPOINT}{NAME}Bind for 0.0.0.0:18080 failed: port is already allocated", 18080),
        (
            f"{ENDPOINT}{NAME}Error starting userland proxy: listen tcp4 0.0.0.0:18099: bind: "
            "address already in use",
            18099,
        ),
        (f"{ENDPOINT}{NAME}listen tcp4 0.0.0.0:18500: bind: address already in use", 18500),
        (f"{ENDPOINT}{NAME}Bind for :::8080 failed: port is already allocated", 8080),
        (
            "failed to set up container networking: "
            f"{ENDPOINT}b ({'0' * 64}): failed to bind host port for 0.0.0.0:11400:172.18.0.2:"
            "11400/tcp: address already in use",
            11400,
        ),
        (
            "Ports are not available: exposing port TCP 127.0.0.1:5000 -> 0.0.0.0:0: listen tcp "
            "127.0.0.1:5000: bind: address already in use",
            5000,
        ),
        ("address already in use", None),
    ],
)
def test_a_port_is_taken(text: str, port: int | None) -> None:
    error = refusal(500, text, "POST /containers/x/start")
    assert isinstance(error, PortTaken)
    assert error.port == port


def test_an_address_that_is_not_this_hosts() -> None:
    text = (
        f"{ENDPOINT}{NAME}Error starting userland proxy: listen tcp4 203.0.113.5:18520: bind: "
        "cannot assign requested address"
    )
    error = refusal(500, text, "")
    assert not isinstance(error, PortTaken)
    assert str(error) == "--publish-address: 203.0.113.5 is not an address of this host"


def test_a_directory_that_does_not_exist() -> None:
    text = (
        'invalid mount config for type "bind": bind source path does not exist: /etc/rosproxy/site'
    )
    assert str(refusal(400, text, "POST /containers/create")).startswith(
        "--zenoh-link-certificates: /etc/rosproxy/site does not exist on the Docker host. Create"
    )


@pytest.mark.parametrize(
    "text", ["No such container: nope", "network nope not found", "No such image: nope:latest"]
)
def test_gone(text: str) -> None:
    assert isinstance(refusal(404, text, ""), NoSuchObject)


def test_a_conflict_without_the_long_ids() -> None:
    error = refusal(409, f'The name "/x" is in use by container "{"ab" * 32}".\n Remove it', "")
    assert isinstance(error, Conflict)
    assert str(error) == 'The name "/x" is in use by container "abababababab". Remove it'


@pytest.mark.parametrize(
    ("status", "text"),
    [(403, "<html>Forbidden</html>"), (405, "Method Not Allowed"), (404, "page not found")],
)
def test_a_proxy_before_the_engine_does_not_let_a_call_through(status: int, text: str) -> None:
    told = str(refusal(status, text, "POST /v1.41/networks/create"))
    assert told.startswith("POST /v1.41/networks/create is refused (HTTP ")
    assert "If a proxy stands in front of the engine's socket, allow this request there" in told


def test_what_the_engine_itself_forbids_is_told_as_it_is() -> None:
    text = "endpoint with name x already exists in network app"
    assert str(refusal(403, text, "POST /x")) == text


def wrapped(error: OSError) -> Exception:
    """An error in the form in which requests raises it over a UNIX socket."""
    inner = urllib3.exceptions.ProtocolError("Connection aborted.", error)
    outer = requests.ConnectionError(inner)
    inner.__context__ = error
    outer.__context__ = inner
    return outer


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (errno.EACCES, "no permission to open the socket /var/run/docker.sock"),
        (errno.ENOENT, "mount the socket (-v /var/run/docker.sock:/var/run/docker.sock)"),
        (errno.ECONNREFUSED, f"no Docker engine answers at {SOCKET}"),
    ],
)
def test_an_engine_that_cannot_be_reached(number: int, words: str) -> None:
    told = str(unreachable(SOCKET, wrapped(OSError(number, "no"))))
    assert words in told
    assert "\n" not in told


def test_the_mounted_socket_of_a_former_engine_is_told(tmp_path: Path) -> None:
    """Like a mounted socket, an open file that was removed has no name."""
    file = tmp_path / "docker.sock"
    file.touch()
    with file.open() as held:
        path = f"/proc/{os.getpid()}/fd/{held.fileno()}"
        refused = wrapped(OSError(errno.ECONNREFUSED, "no"))
        assert not isinstance(unreachable(f"unix://{path}", refused), FormerSocket)
        file.unlink()
        error = unreachable(f"unix://{path}", refused)
    assert isinstance(error, FormerSocket)
    assert f"this container has the old {path}. Restart this container" in str(error)


def test_a_cause_is_found_too() -> None:
    outer = EngineError("Error while fetching server API version")
    outer.__cause__ = wrapped(OSError(errno.ECONNREFUSED, "refused"))
    assert "Start the engine" in str(unreachable("tcp://10.0.0.1:2375", outer))


def test_anything_else_is_told_in_one_line() -> None:
    told = str(unreachable(SOCKET, requests.ReadTimeout("Read timed out.")))
    assert told == f"a request to the Docker engine at {SOCKET} failed: Read timed out."
