"""The Docker engine that the tests use: by its command line, and what is asked often by its API."""

import contextlib
import fcntl
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from docker.errors import DockerException, NotFound
from requests.exceptions import RequestException

from docker import APIClient

ROOT = Path(__file__).resolve().parents[2]
_USERS = Path("/run/lock/rosproxy-tests-engine")
_DOOR = Path("/run/lock/rosproxy-tests-engine-door")
_STARTED = Path("/run/lock/rosproxy-tests-engine-started")
"""The process of the engine that was started here, and the policy for forwarding before it."""
_PID = Path("/run/docker.pid")


def run(*command: str | Path, check: bool = True, seconds: float = 60, **options: Any) -> str:
    """Run a command, return what it prints, show all of it when it fails."""
    done = subprocess.run(
        [str(argument) for argument in command],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=seconds,
        check=False,
        **options,
    )
    if check and done.returncode != 0:
        words = " ".join(map(str, command))
        raise AssertionError(f"{words}: exit {done.returncode}\n{done.stdout}")
    return str(done.stdout).strip()


def docker(
    *arguments: str | Path, check: bool = True, seconds: float = 60, engine: str = ""
) -> str:
    """Run Docker's command line, with the engine that DOCKER_HOST names unless another is."""
    host = ("--host", engine) if engine else ()
    return run("docker", *host, *arguments, check=check, seconds=seconds)


def pause(container: str) -> None:
    """Pause a container.

    With version 1 of control groups runc tries to freeze a container for a moment and then gives
    up, "a game of chances" in its authors' words (opencontainers/runc#2791): on a busy machine it
    takes several calls.
    """

    def paused() -> bool:
        said = docker("pause", container, check=False)
        assert said == container or "unable to freeze" in said, said
        return said == container

    wait_until(paused, 30, f"{container} is paused")


def engine_url() -> str:
    """The engine that is used now."""
    return os.environ.get("DOCKER_HOST") or "unix:///var/run/docker.sock"


@cache
def _api(url: str) -> APIClient:
    """The API of an engine, without a program to start for each question."""
    return APIClient(base_url=url, timeout=60)


def inspect(name: str, *, check: bool = True) -> dict[str, Any]:
    """Everything that the engine knows about a container or an image; empty if it knows none."""
    try:
        api = _api(engine_url())
        try:
            inspection: dict[str, Any] = api.inspect_container(name)
        except NotFound:
            inspection = api.inspect_image(name)
    except (DockerException, RequestException) as error:
        if check:
            raise AssertionError(f"inspect {name}: {error}") from None
        return {}
    return inspection


def containers(*labels: str, check: bool = True) -> list[dict[str, Any]]:
    """All containers with these labels, in whatever state, as the engine lists them."""
    try:
        listed = _api(engine_url()).containers(all=True, filters={"label": list(labels)})
    except (DockerException, RequestException) as error:
        if check:
            raise AssertionError(f"containers with {' '.join(labels)}: {error}") from None
        return []
    return list(listed)


def logs(name: str) -> str:
    """What a container has printed; why it can't be said if the engine does not tell."""
    try:
        return bytes(_api(engine_url()).logs(name)).decode(errors="replace").strip()
    except (DockerException, RequestException) as error:
        return f"logs of {name}: {error}"


def wait_until(
    condition: Callable[[], bool], seconds: float, message: str | Callable[[], str]
) -> float:
    """Wait for something to come true; return the seconds it took.

    Who has waited long is asked less often: many questions are a program to start.
    """
    started = time.monotonic()
    while not condition():
        waited = time.monotonic() - started
        if waited > seconds:
            raise AssertionError(
                f"not in {seconds} s: {message if isinstance(message, str) else message()}"
            )
        time.sleep(min(max(0.1, waited / 20), 0.5))
    return time.monotonic() - started


def answers() -> bool:
    return subprocess.run(["docker", "info"], capture_output=True, check=False).returncode == 0


@contextmanager
def running_engine(log: Path) -> Iterator[None]:
    """Use the engine that runs; start one where none does.

    Several processes may be in here at the same time: each holds a shared lock as long as it uses
    the engine. The last one to leave stops it, if it is one that was started here; who comes
    meanwhile waits at the door, and starts one of its own.
    """
    with _DOOR.open("w") as door, _USERS.open("w") as users:
        fcntl.flock(door, fcntl.LOCK_EX)
        if not answers():
            _start_engine(log)
        fcntl.flock(users, fcntl.LOCK_SH)
        fcntl.flock(door, fcntl.LOCK_UN)
        try:
            yield
        finally:
            fcntl.flock(users, fcntl.LOCK_UN)
            fcntl.flock(door, fcntl.LOCK_EX)
            with contextlib.suppress(BlockingIOError):  # others use it
                fcntl.flock(users, fcntl.LOCK_EX | fcntl.LOCK_NB)
                _stop_engine()


def _start_engine(log: Path) -> None:
    """Start an engine that outlives this process, and wait until it answers."""
    policy = forward_policy()
    # Memory for time: fewer garbage collections, in its containerd as well.
    run("setsid", "--fork", "sh", "-c", 'exec env GOGC=400 dockerd >"$0" 2>&1', log)
    wait_until(answers, 60, log.read_text)
    _STARTED.write_text(f"{_PID.read_text().strip()} {policy}")


def _stop_engine() -> None:
    """Stop the engine, if it is one that was started here."""
    if not _STARTED.exists():
        return
    number, policy = _STARTED.read_text().split()
    _STARTED.unlink()
    if not _PID.exists() or _PID.read_text().strip() != number:
        return
    os.kill(int(number), signal.SIGTERM)
    wait_until(lambda: not _runs(number), 60, "the engine has stopped")
    run("iptables", "-P", "FORWARD", policy)


def _runs(process: str) -> bool:
    """Whether a process is there, and has not ended without anybody asking how."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def forward_policy() -> str:
    """The policy for forwarded packets, which an engine sets to DROP and leaves so."""
    first = run("iptables", "-S", "FORWARD").splitlines()[0]
    return first.rsplit(" ", 1)[-1]


def build(tag: str, *arguments: str | Path) -> str:
    """Build an image; the network is the host's, so that package indexes are in reach."""
    docker("build", "--network", "host", "--tag", tag, *arguments, seconds=600)
    return tag


def compose_command() -> list[str]:
    """Compose as this machine has it: the plug-in, or the program of its first version."""
    if subprocess.run(
        ["docker", "compose", "version"], capture_output=True, check=False
    ).returncode:
        return [shutil.which("docker-compose") or "docker-compose"]
    return ["docker", "compose"]


def compose(project: Path, *arguments: str, variables: dict[str, str]) -> str:
    """Run Compose on the example in a directory, with these variables in its environment."""
    command = [*compose_command(), "--project-name", "rosproxy-test", *arguments]
    return run(*command, cwd=project, env={**os.environ, **variables}, seconds=120)
