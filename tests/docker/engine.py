"""The Docker engine of the tests: by command line, and by API for frequent questions."""

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
"""The process of an engine that the tests started, and the former policy for forwarding."""
_PID = Path("/run/docker.pid")


def run(*command: str | Path, check: bool = True, seconds: float = 60, **options: Any) -> str:
    """Run a command and return the output. A failure shows the whole output."""
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

    With version 1 of control groups runc tries to freeze a container only for a moment, "a game of
    chances" (opencontainers/runc#2791). So pausing may take several calls on a busy machine.
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
    """The engine's inspection of a container or an image; empty if unknown."""
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
    """The engine's list of all containers with these labels, in any state."""
    try:
        listed = _api(engine_url()).containers(all=True, filters={"label": list(labels)})
    except (DockerException, RequestException) as error:
        if check:
            raise AssertionError(f"containers with {' '.join(labels)}: {error}") from None
        return []
    return list(listed)


def logs(name: str) -> str:
    """The output of a container, or the engine's error."""
    try:
        return bytes(_api(engine_url()).logs(name)).decode(errors="replace").strip()
    except (DockerException, RequestException) as error:
        return f"logs of {name}: {error}"


def wait_until(
    condition: Callable[[], bool], seconds: float, message: str | Callable[[], str]
) -> float:
    """Wait for a condition.

    Return the seconds. The intervals grow, because many conditions start a program.
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
    """Use the running engine, or start an engine.

    Several processes may use the engine at the same time, each with a shared lock. The last process
    stops the engine if the tests started this engine. A process that comes meanwhile waits at the
    door, and starts a new engine.
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
            with contextlib.suppress(BlockingIOError):  # other users
                fcntl.flock(users, fcntl.LOCK_EX | fcntl.LOCK_NB)
                _stop_engine()


def _start_engine(log: Path) -> None:
    """Start an engine that outlives this process, and wait for answers."""
    policy = forward_policy()
    # Memory for time: fewer garbage collections, in containerd as well.
    run("setsid", "--fork", "sh", "-c", 'exec env GOGC=400 dockerd >"$0" 2>&1', log)
    wait_until(answers, 60, log.read_text)
    _STARTED.write_text(f"{_PID.read_text().strip()} {policy}")


def _stop_engine() -> None:
    """Stop the engine if the tests started this engine."""
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
    """Whether a process runs and is no zombie."""
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
    """The command of Compose on this machine: the plug-in, or the program of version 1."""
    if subprocess.run(
        ["docker", "compose", "version"], capture_output=True, check=False
    ).returncode:
        return [shutil.which("docker-compose") or "docker-compose"]
    return ["docker", "compose"]


def compose(project: Path, *arguments: str, variables: dict[str, str]) -> str:
    """Run Compose on the example in a directory, with these environment variables."""
    command = [*compose_command(), "--project-name", "rosproxy-test", *arguments]
    return run(*command, cwd=project, env={**os.environ, **variables}, seconds=120)
