"""An engine with ROS 2 nodes that is ended or killed, and restarted.

The engine is private, so that other containers are not touched.
"""

import signal
import time
from collections.abc import Iterator

import pytest

from tests.docker.controller import Process, the_proxy
from tests.docker.engine import docker, wait_until
from tests.docker.inside import Inside
from tests.docker.machines import addresses
from tests.docker.private_engine import PrivateEngine, private_engine
from tests.docker.ros2 import Flow, Inside2, Outside, all_run, machine_on_lan, runs

NUMBER = 92
RESTART = ("--restart", "always")
LIVE = ("--live-restore",)


@pytest.fixture(scope="module")
def engine(
    tmp_path_factory: pytest.TempPathFactory, ros2_image: str, proxy_image: str
) -> Iterator[PrivateEngine]:
    with private_engine(tmp_path_factory.mktemp("private")) as engine:
        engine.load(ros2_image, proxy_image)
        yield engine


@pytest.fixture(scope="module")
def neighbour(ros2_image: str, engine: PrivateEngine) -> Iterator[Outside]:
    """A machine on the LAN, on this machine's engine, which outlives the private engine."""
    with machine_on_lan(ros2_image, "neighbour", NUMBER, engine.namespace) as outside:
        yield outside


@pytest.fixture(scope="module")
def flow(
    engine: PrivateEngine, neighbour: Outside, ros2_image: str, proxy_image: str,
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Flow]:  # fmt: skip
    """Traffic, with a controller in the network namespace of the engine."""
    process = Process(
        tmp_path_factory.mktemp("controller"), "--proxy-image", proxy_image, "--ports", "32",
        "--advertise-host", addresses(NUMBER)[0], namespace=engine.namespace,
        environment={"DOCKER_HOST": engine.url},
    )  # fmt: skip
    process.start()
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("DOCKER_HOST", engine.url)
            yield Flow(neighbour, Inside2(Inside(ros2_image, "")), options=RESTART)
    finally:
        process.stop()
        print(process.logs())


@pytest.mark.parametrize(("how", "then"), [(signal.SIGKILL, ()), (signal.SIGTERM, LIVE)])
def test_everything_comes_back_with_the_engine(
    how: signal.Signals, then: tuple[str, ...], engine: PrivateEngine, flow: Flow
) -> None:
    """The engine ends the containers, at the latest after its return, and restarts them, perhaps
    with other addresses.
    """
    proxy = the_proxy()
    port_range = proxy.ports

    engine.end(how)
    engine.start(*then)
    began = time.time()

    wait_until(lambda: all_run(proxy), 60, lambda: docker("ps", "--all"))
    flow.wait(since=time.time(), seconds=90)
    first = [min(got.at for got in log.got(text) if got.at > began) for log, text in flow.heard]
    print(f"{how.name}: heard outside {first[0] - began:.1f} s, inside {first[1] - began:.1f} s "
          "after the engine was there again")  # fmt: skip
    assert proxy.ports == port_range


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
def test_nobody_notices_an_engine_with_live_restore(
    how: signal.Signals, engine: PrivateEngine, flow: Flow
) -> None:
    """Containers go on without the engine, and so do proxy and LAN relay."""
    proxy = the_proxy()
    before = runs(proxy)
    began = time.time()

    engine.end(how)
    engine.start(*LIVE)

    flow.wait(since=time.time())
    print(f"{how.name}: {flow.gaps(began)}")
    assert runs(proxy) == before
