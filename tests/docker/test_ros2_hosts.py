"""Two hosts with an engine and an operator each, as peers without multicast between the hosts."""

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.docker.controller import WINDOW, Process, remove_proxies
from tests.docker.engine import logs, run
from tests.docker.inside import Container, Inside, remove_marked
from tests.docker.machines import addresses, cable
from tests.docker.nodes import Log
from tests.docker.private_engine import PrivateEngine, private_engine
from tests.docker.ros2 import Inside2, ros2_proxies, wait_for_line

NUMBER = 93
HERE, THERE = addresses(NUMBER)


@dataclass(frozen=True)
class Host:
    """A host. ``url`` is the address of its engine, empty for this machine's engine."""

    url: str

    @contextmanager
    def used(self) -> Iterator[None]:
        """Send all calls in this context to this host's engine."""
        with pytest.MonkeyPatch.context() as patch:
            if self.url:
                patch.setenv("DOCKER_HOST", self.url)
            yield

    def log(self, container: Container) -> Log:
        def read() -> str:
            with self.used():
                return logs(container.name)

        return Log(read)


@contextmanager
def between(engine: PrivateEngine) -> Iterator[None]:
    """A cable between this machine and the other engine's network namespace."""
    near = cable(NUMBER)
    far = "eth0"
    into = ("nsenter", f"--net={engine.namespace}")
    run("ip", "link", "add", near, "type", "veth", "peer", "name", far, "netns", engine.name)
    try:
        run("ip", "address", "add", f"{HERE}/30", "dev", near)
        run(*into, "ip", "address", "add", f"{THERE}/30", "dev", far)
        run("ip", "link", "set", near, "up")
        run(*into, "ip", "link", "set", far, "up")
        yield
    finally:
        run("ip", "link", "delete", near, check=False)


@pytest.fixture(scope="module")
def hosts(
    tmp_path_factory: pytest.TempPathFactory, ros2_image: str, proxy_image: str,
    _no_other_controller: None,
) -> Iterator[tuple[Host, Host]]:  # fmt: skip
    with ExitStack() as stack:
        engine = stack.enter_context(private_engine(tmp_path_factory.mktemp("private")))
        engine.load(ros2_image, proxy_image)
        stack.enter_context(between(engine))
        for own, peer, url, namespace in (
            (HERE, THERE, "", ""),
            (THERE, HERE, engine.url, engine.namespace),
        ):
            stack.enter_context(operator(
                tmp_path_factory.mktemp("operator"), url, namespace, "--proxy-image", proxy_image,
                "--ports", "32", "--advertise-host", own, "--ros2-lan", "none",
                "--ros2-peer", f"{peer}:{WINDOW[0]}",
            ))  # fmt: skip
        stack.callback(remove_proxies)
        stack.callback(remove_marked)
        yield Host(""), Host(engine.url)


@contextmanager
def operator(directory: Path, url: str, namespace: str, *options: str) -> Iterator[None]:
    environment = {"DOCKER_HOST": url} if url else None
    process = Process(directory, *options, namespace=namespace, environment=environment)
    process.start()
    try:
        yield
    finally:
        process.stop()
        print(process.logs())


def test_containers_on_two_hosts(hosts: tuple[Host, Host], ros2_image: str) -> None:
    """Topics and services in both directions."""
    heard: list[Log] = []
    called: list[Log] = []
    for index, host in enumerate(hosts):
        with host.used():
            inside = Inside2(Inside(ros2_image, ""))
            network = inside.made.network()
            own = index
            other = 1 - index
            inside.node(network, "jazzy", "pub", f"/from{own}", "--word", f"host{own}")
            inside.node(network, "kilted", "serve", f"/serve{own}", "--word", f"host{own}")
            listener = inside.node(network, "jazzy", "sub", f"/from{other}")
            caller = inside.node(network, "jazzy", "call", f"/serve{other}")
            heard.append(host.log(listener))
            called.append(host.log(caller))
    started = time.time()
    for index, log in enumerate(heard):
        first = log.wait_for(f"host{1 - index}", count=10)
        print(f"heard on host {index} after {first - started:.1f} s")
    for index, log in enumerate(called):
        wait_for_line(log, rf"^reply \d+ host{1 - index} ")
    for host in hosts:
        with host.used():
            assert len(ros2_proxies()) == 1
