"""An operator in a container with the engine's socket mounted outlives the engine."""

from collections.abc import Iterator

import pytest

from tests.docker.controller import HARDENED
from tests.docker.engine import docker, wait_until
from tests.docker.private_engine import PrivateEngine, private_engine

NAME = "operator"
LIVE = ("--live-restore",)
MOUNTED = "/var/run/docker.sock"


@pytest.fixture
def engine(
    tmp_path_factory: pytest.TempPathFactory, controller_image: str
) -> Iterator[PrivateEngine]:
    with private_engine(tmp_path_factory.mktemp("private")) as engine:
        engine.load(controller_image)
        engine.end()
        engine.start(*LIVE)
        yield engine


def test_the_operator_gets_the_socket_of_the_new_engine(
    engine: PrivateEngine, controller_image: str
) -> None:
    """The mounted file stays that of the former engine until the container starts again."""
    socket = engine.url.removeprefix("unix://")
    docker("run", "--detach", "--name", NAME, "--restart", "always", "--network", "host",
           *HARDENED, "--volume", f"{socket}:{MOUNTED}", controller_image, "docker",
           engine=engine.url)  # fmt: skip

    def logs() -> str:
        return docker("logs", NAME, engine=engine.url, check=False)

    def is_well() -> bool:
        asked = ("exec", NAME, "rosproxy-operator", "docker", "status")
        said = docker(*asked, engine=engine.url, check=False)
        return "0 containers" in said and "No operator was asked" not in said

    wait_until(is_well, 60, logs)

    engine.end()
    engine.start(*LIVE)

    wait_until(lambda: "this container has the old /var/run/docker.sock" in logs(), 60, logs)
    wait_until(is_well, 60, logs)
    # The engine's RestartCount misses a container that ended before the new engine's start.
    assert logs().count("health and metrics at") == 2, logs()
