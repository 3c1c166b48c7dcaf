"""The controller, in a container like users run it, or as a process that tests can kill."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.docker.engine import containers, docker, inspect, logs, wait_until

PROGRAM = Path(sys.executable).with_name("rosproxy-operator")
MANAGED = "io.rosproxy.managed=true"
UPLINK = "0-rosproxy"
WINDOW = range(12000, 13000)
ADMIN_BIND = ("--admin-bind", "127.0.0.1:21313")
OPTIONS = ("--port-window", f"{WINDOW[0]}-{WINDOW[-1]}", "--ports", "6", "--grace", "3",
           "--resync", "5", *ADMIN_BIND)  # fmt: skip
HARDENED = ("--read-only", "--cap-drop", "ALL", "--security-opt", "no-new-privileges:true",
            "--user", "0:0")  # fmt: skip


@dataclass(frozen=True)
class Proxy:
    """A proxy of a controller: the proxy's container, and a sandbox."""

    name: str

    @property
    def sandbox(self) -> str:
        return f"{self.name}-ports"

    @property
    def lan_relay(self) -> str:
        """The container of the LAN relay, for ROS 2."""
        return f"{self.name}-lan-relay"

    @property
    def id(self) -> str:
        """The id of the container; empty if missing."""
        return str(inspect(self.name, check=False).get("Id", ""))

    @property
    def image(self) -> str:
        """The name of the image."""
        inspection = inspect(self.name, check=False) or inspect(self.sandbox, check=False)
        return str(inspection["Config"]["Image"]) if inspection else ""

    @property
    def ports(self) -> range:
        first, last = inspect(self.sandbox)["Config"]["Labels"]["io.rosproxy.range"].split("-")
        return range(int(first), int(last) + 1)

    @property
    def running(self) -> bool:
        """Whether both containers run, and the proxy is in the sandbox's network."""
        inspections = [inspect(name, check=False) for name in (self.name, self.sandbox)]
        if not all(
            inspection and inspection["State"]["Running"] and not inspection["State"]["Paused"]
            for inspection in inspections
        ):
            return False
        return bool(
            inspections[0]["HostConfig"]["NetworkMode"] == f"container:{inspections[1]['Id']}"
        )

    @property
    def networks(self) -> set[str]:
        inspection = inspect(self.sandbox, check=False)
        return set(inspection["NetworkSettings"]["Networks"]) - {UPLINK} if inspection else set()

    def aliases(self, network: str) -> set[str]:
        inspection = inspect(self.sandbox)
        return set(inspection["NetworkSettings"]["Networks"][network]["Aliases"]) - {
            inspection["Id"][:12]
        }

    def flowing(self) -> set[str]:
        """Topics and services with sent bytes on open connections of the proxy."""
        status = json.loads(docker("exec", self.name, "rosproxy", "status", "--json", check=False))
        links = [link for node in status["nodes"] for link in node["connections"]]
        return {link["name"] for link in links if link["sent"]}

    def address(self, network: str) -> str:
        return str(inspect(self.sandbox)["NetworkSettings"]["Networks"][network]["IPAddress"])


def managed(role: str, *, check: bool = True) -> list[str]:
    """The names of the containers that a controller has made, in whatever state."""
    listed = containers(MANAGED, f"io.rosproxy.role={role}", check=check)
    return sorted(
        container["Names"][0].removeprefix("/") for container in listed if container["Names"]
    )


def proxies(*, check: bool = True) -> list[Proxy]:
    """All proxies on this engine, also with a missing container."""
    boxes = (name.removesuffix("-ports") for name in managed("ports", check=check))
    names = {*managed("proxy", check=check), *boxes}
    return [Proxy(name) for name in sorted(names)]


def published_ranges() -> list[range]:
    """The ranges of all proxies by a single call: a proxy that is being replaced cannot be
    inspected.
    """
    listed = containers(MANAGED, "io.rosproxy.role=ports")
    ranges = (container["Labels"]["io.rosproxy.range"] for container in listed)
    ends = [tuple(map(int, text.split("-"))) for text in ranges]
    return [range(first, last + 1) for first, last in ends]


def the_proxy(seconds: float = 30) -> Proxy:
    """Wait until a single proxy runs. Return the proxy."""
    wait_until(
        lambda: [proxy.running for proxy in proxies()] == [True],
        seconds, lambda: docker("ps", "--all"),
    )  # fmt: skip
    return proxies()[0]


def remove_proxies() -> None:
    """Remove all proxies and the uplink."""
    roles = ("redirect", "flush", "lan-relay", "proxy", "ports")
    names = [name for role in roles for name in managed(role)]
    if names:
        docker("rm", "--force", *names, check=False, seconds=120)
    docker("network", "rm", UPLINK, check=False)


@dataclass(frozen=True)
class Controller:
    """A controller in a container."""

    container: str
    options: tuple[str, ...]

    def logs(self) -> str:
        return logs(self.container)

    def command(self, *words: str, check: bool = True) -> str:
        """Run a command in the container. The command asks the controller, which has the
        options.
        """
        return docker("exec", self.container, "rosproxy-operator", "docker", *words, check=check)

    def status(self) -> dict[str, Any]:
        document: dict[str, Any] = json.loads(self.command("status", "--json", check=False))
        return document

    def problems(self) -> str:
        return "\n".join(
            f"{problem['subject']}: {problem['text']}. {problem['fix']}"
            for problem in self.status()["problems"]
        )

    def kill(self) -> None:
        docker("kill", self.container)

    def start(self) -> None:
        docker("start", self.container)


@contextmanager
def running_controller(
    image: str, *options: str, names: Mapping[str, str], container: str = ""
) -> Iterator[Controller]:
    """A controller as in examples/docker/compose.yaml.

    Later options win. ``names`` are entries of the hosts file.
    """
    container = container or f"rosproxy-test-controller-{os.getpid()}"
    every = (*OPTIONS, *options)
    hosts = [
        argument
        for name, address in names.items()
        for argument in ("--add-host", f"{name}:{address}")
    ]
    docker("run", "--detach", "--name", container, "--network", "host", *HARDENED, *hosts,
           "--volume", "/var/run/docker.sock:/var/run/docker.sock", image, "docker",
           *every)  # fmt: skip
    try:
        yield Controller(container, every)
    finally:
        print(logs(container))
        docker("rm", "--force", container, check=False)


class Process:
    """A controller outside of containers, with its own hosts file."""

    def __init__(
        self, directory: Path, *options: str, names: Mapping[str, str] | None = None,
        namespace: str = "", environment: Mapping[str, str] | None = None,
    ) -> None:  # fmt: skip
        self._directory = directory
        self.options = (*OPTIONS, *options)
        self._hosts = directory / "hosts"
        self._names: dict[str, str] = {}
        self._hosts.touch()
        for name, address in (names or {}).items():
            self.name(name, address)
        self._namespace = namespace
        # Nothing here speaks TLS, and to read the authorities takes a tenth of a second.
        self.environment = {"SSL_CERT_FILE": "/dev/null", **(environment or {})}
        self._log = directory / "controller.log"
        self.process: subprocess.Popen[bytes] | None = None

    def name(self, name: str, address: str) -> None:
        """Let a name lead to an address, from now on."""
        self._names[name] = address
        self._hosts.write_text("".join(f"{at} {name}\n" for name, at in self._names.items()))

    def start(self) -> None:
        with self._log.open("ab") as log:
            self.process = subprocess.Popen(
                self._command(), stdout=log, stderr=log, env={**os.environ, **self.environment}
            )

    def once(self, *words: str, check: bool = True, seconds: float = 120) -> str:
        """Run until the end: --once, plan or status."""
        environment = {**os.environ, **self.environment}
        self.process = subprocess.Popen(
            self._command(*words), stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            env=environment,
        )  # fmt: skip
        text = self.process.communicate(timeout=seconds)[0].decode().strip()
        code = self.process.returncode
        assert code == 0 or not check, f"rosproxy-operator {' '.join(words)}: exit {code}\n{text}"
        return text

    def send(self, number: int) -> None:
        """Send a signal to the process."""
        assert self.process is not None
        self.process.send_signal(number)

    def kill(self, number: int = signal.SIGKILL) -> int:
        """Send a signal and wait for the end. Return the exit status."""
        self.send(number)
        assert self.process is not None
        return self.process.wait(30)

    def stop(self) -> None:
        if self.process is not None and self.process.poll() is None:
            self.kill()

    def logs(self) -> str:
        return self._log.read_text()

    def _command(self, *words: str) -> tuple[str, ...]:
        """In a mount namespace with our hosts file over the machine's."""
        mount = f'mount --bind {self._hosts} /etc/hosts && exec "$@"'
        enter = ("nsenter", f"--net={self._namespace}") if self._namespace else ()
        return (*enter, "unshare", "--mount", "sh", "-c", mount, "sh",
                str(PROGRAM), "docker", *self.options, *words)  # fmt: skip
