"""An engine without userland proxy ends and starts again.

The engine is private, so the test does not touch other containers.
"""

import signal
import time
from collections.abc import Iterator

import pytest

from tests.docker.controller import Process, the_proxy
from tests.docker.engine import wait_until
from tests.docker.inside import Inside
from tests.docker.nodes import LIBRARIES, UNNOTICED, Log
from tests.docker.private_engine import PrivateEngine, private_engine
from tests.docker.robot import Robot, named_robot

NUMBER = 84
RESTART = ("--restart", "always")
LIVE = ("--live-restore",)


@pytest.fixture(scope="module")
def engine(
    tmp_path_factory: pytest.TempPathFactory, ros_image: str, proxy_image: str
) -> Iterator[PrivateEngine]:
    with private_engine(tmp_path_factory.mktemp("private")) as engine:
        engine.load(ros_image, proxy_image)
        yield engine


@pytest.fixture(scope="module")
def robot(ros_image: str, engine: PrivateEngine) -> Iterator[Robot]:
    """A robot on this machine's engine, which outlives the private engine."""
    with named_robot(ros_image, "android", NUMBER, engine.namespace) as robot:
        robot.start_master()
        yield robot


@pytest.fixture(scope="module")
def controller(
    engine: PrivateEngine, robot: Robot, proxy_image: str, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Process]:
    """A controller in the network namespace of the engine."""
    process = Process(
        tmp_path_factory.mktemp("controller"), "--proxy-image", proxy_image,
        names={robot.name: robot.address}, namespace=engine.namespace,
        environment={"DOCKER_HOST": engine.url},
    )  # fmt: skip
    process.start()
    yield process
    process.stop()
    print(process.logs())


@pytest.fixture(scope="module")
def listeners(
    engine: PrivateEngine, robot: Robot, controller: Process, ros_image: str
) -> Iterator[dict[str, Log]]:
    """The output of the listeners on the robot, for a rospy node and a roscpp node inside."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DOCKER_HOST", engine.url)
        inside = Inside(ros_image, robot.master_uri)
        network = inside.network()
        inside.network()
        for library in LIBRARIES:
            inside.node(network, library, "pub", "--topic", f"/{library}", "--word", "inside",
                        options=RESTART)  # fmt: skip
        yield {
            library: robot.node(f"listener_{library}", library, "sub", "--topic", f"/{library}")
            for library in LIBRARIES
        }


@pytest.mark.parametrize(("how", "then"), [(signal.SIGKILL, ()), (signal.SIGTERM, LIVE)])
def test_everything_comes_back_with_the_engine(
    how: signal.Signals,
    then: tuple[str, ...],
    engine: PrivateEngine,
    controller: Process,
    listeners: dict[str, Log],
) -> None:
    """The engine ends the containers, at the latest after the restart of the engine. Then the
    engine starts the containers again, perhaps with other addresses.
    """
    for listener in listeners.values():
        listener.wait_for("inside")
    ports = the_proxy().ports
    process = controller.process

    engine.end(how)
    assert process is not None
    assert process.poll() is None, controller.logs()
    engine.start(*then)
    began = time.time()

    for library, listener in listeners.items():
        heard = listener.wait_for("inside", since=began, seconds=60)
        print(
            f"{how.name}, {library}: heard {heard - began:.1f} s after the engine was there again"
        )
    assert the_proxy().ports == ports
    assert process.poll() is None, controller.logs()


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
def test_nobody_notices_an_engine_with_live_restore(
    how: signal.Signals, engine: PrivateEngine, controller: Process, listeners: dict[str, Log]
) -> None:
    """Containers go on without the engine, and so does the proxy."""
    began = time.time()
    number = the_proxy().id

    engine.end(how)
    time_without = time.time()
    engine.start(*LIVE)

    for listener in listeners.values():
        listener.wait_for("inside", since=time.time())
        assert listener.lost("inside", began) == 0
        assert listener.longest_gap("inside", began, time.time()) < UNNOTICED
    print(f"{how.name}: {time.time() - time_without:.1f} s without the engine")
    assert the_proxy().id == number


def test_controller_works_on_after_all_that(
    engine: PrivateEngine,
    controller: Process,
    listeners: dict[str, Log],
    robot: Robot,
    ros_image: str,
) -> None:
    inside = Inside(ros_image, robot.master_uri)

    node = inside.node(inside.network(), "roscpp", "pub", "--topic", "/late")

    wait_until(lambda: robot.knows_proxied(node.node), 60, controller.logs)
