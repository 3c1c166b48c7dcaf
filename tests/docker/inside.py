"""Labelled containers: ROS nodes in ordinary bridged networks."""

import itertools
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.docker.engine import containers, docker, inspect, logs
from tests.docker.nodes import Log, node_command

_LABEL = "test.of.rosproxy"
MARK = f"{_LABEL}={os.getpid()}"
ENABLE = "rosproxy.enable=true"
_numbers = itertools.count(1)


def unique(kind: str) -> str:
    return f"rpx-{kind}-{os.getpid()}-{next(_numbers)}"


@dataclass
class Inside:
    """Makes networks and containers, removed at the end."""

    image: str
    master_uri: str
    networks: list[str] = field(default_factory=list)

    def network(self, *options: str) -> str:
        name = unique("net")
        docker("network", "create", "--label", MARK, *options, name)
        self.networks.append(name)
        return name

    def run(
        self, network: str, *command: str, name: str = "", image: str = "", uri: str | None = None,
        labels: tuple[str, ...] = (ENABLE,), options: tuple[str, ...] = (), verb: str = "run",
    ) -> "Container":  # fmt: skip
        """Start a container as a user would: a network, ROS_MASTER_URI and a label."""
        name = name or unique("node")
        uri = self.master_uri if uri is None else uri
        words = [verb, *(["--detach"] if verb == "run" else []), "--name", name]
        words += ["--network", network, "--label", MARK, "--init", *options]
        words += ["--env", f"ROS_MASTER_URI={uri}"] if uri else []
        words += [argument for label in labels for argument in ("--label", label)]
        docker(*words, image or self.image, *command)
        return Container(name)

    def node(self, network: str, library: str, role: str, *words: str, **more: Any) -> "Container":
        """Start a test node in a container. Both have the same name."""
        name = more.setdefault("name", unique(role))
        return self.run(
            network, *node_command(library, role, *words, f"__name:={Container(name).node}"), **more
        )

    def idle(self, network: str, **more: Any) -> "Container":
        """Start a container that runs no node: the controller can't tell."""
        return self.run(network, "sleep", "infinity", **more)


@dataclass(frozen=True)
class Container:
    name: str

    @property
    def node(self) -> str:
        """The ROS name of the test node in this container."""
        return self.name.replace("-", "_")

    @property
    def log(self) -> Log:
        return Log(lambda: logs(self.name))

    @property
    def state(self) -> str:
        return str(inspect(self.name)["State"]["Status"])

    def run(self, *command: str, seconds: float = 30, check: bool = True) -> str:
        return docker(
            "exec", self.name, "timeout", str(seconds), *command, check=check, seconds=seconds + 10
        )

    def start(self, *command: str) -> None:
        docker("exec", "--detach", self.name, *command)

    def address(self, network: str) -> str:
        return str(inspect(self.name)["NetworkSettings"]["Networks"][network]["IPAddress"])

    def resolve(self, name: str) -> set[str]:
        """The addresses of a name in this container."""
        lines = self.run("getent", "ahostsv4", name, check=False).splitlines()
        return {line.split()[0] for line in lines}

    def remove(self) -> None:
        docker("rm", "--force", self.name, check=False)


@contextmanager
def inside(image: str, master_uri: str) -> Iterator[Inside]:
    """An `Inside`. Everything made there is removed afterwards."""
    made = Inside(image, master_uri)
    try:
        yield made
    finally:
        remove_marked()


def remove_marked(mark: str = MARK) -> None:
    """Remove all containers and networks that the tests have made, here or with another mark."""
    ids = [container["Id"] for container in containers(mark)]
    if ids:
        docker("rm", "--force", *ids, check=False, seconds=120)
    for network in docker("network", "ls", "--quiet", "--filter", f"label={mark}").split():
        for container in attached(network):
            docker("network", "disconnect", "--force", network, container, check=False)
        docker("network", "rm", network, check=False)


def remove_leftovers() -> None:
    """Remove containers and networks of killed test runs."""
    labels = docker("ps", "--all", "--format", f'{{{{.Label "{_LABEL}"}}}}').split()
    labels += docker("network", "ls", "--format", f'{{{{.Label "{_LABEL}"}}}}').split()
    for pid in set(labels):
        if not Path(f"/proc/{pid}").exists():
            remove_marked(f"{_LABEL}={pid}")


def attached(network: str) -> list[str]:
    """The names of the running containers on a network."""
    inspections = json.loads(docker("network", "inspect", network, check=False) or "[]")
    return [container["Name"] for net in inspections for container in net["Containers"].values()]
