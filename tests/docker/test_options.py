"""Controllers with different options."""

import time
from collections.abc import Callable

import pytest

from tests.docker.controller import Controller, Proxy, managed, the_proxy
from tests.docker.engine import docker, inspect, wait_until
from tests.docker.images import update
from tests.docker.inside import ENABLE, Inside
from tests.docker.nodes import LIBRARIES
from tests.docker.robot import Robot
from tests.docker.test_data_plane import wait_forwarded
from tests.docker.traffic import traffic


def test_expose_by_default(start_controller: Callable[..., Controller], net: Inside) -> None:
    network = net.network()
    other = net.network()
    net.idle(network, labels=())
    net.idle(other, labels=("rosproxy.enable=false",))
    start_controller("--expose-by-default")

    proxy = the_proxy()

    wait_until(lambda: proxy.networks == {network}, 60, lambda: str(proxy.networks))


def test_master_of_the_controller_serves_those_who_name_none(
    start_controller: Callable[..., Controller], net: Inside, named: Robot
) -> None:
    start_controller("--master-uri", named.master_uri, "--advertise-host", named.host_address)
    node = net.node(net.network(), "rospy", "pub", "--topic", "/out", uri="http://rosproxy:11311")

    wait_until(lambda: named.knows_proxied(node.node), 60, node.log.read)


@pytest.mark.parametrize("library", LIBRARIES)
def test_updated_image_replaces_the_proxy(
    library: str, start_controller: Callable[..., Controller], moving_image: str, net: Inside,
    named: Robot,
) -> None:  # fmt: skip
    start_controller("--proxy-image", moving_image)
    with traffic(net, named, net.network(), library) as flow:
        before = the_proxy()
        name = before.name
        number = before.id
        ports = before.ports
        token = secret(before)
        changed = time.time()

        update(moving_image)

        wait_until(lambda: the_proxy().id not in ("", number), 60, "another container")
        flow.wait(since=time.time())
        print(f"image updated: {flow.gaps(changed)}")
        after = the_proxy()
        assert (after.name, after.ports, secret(after)) == (name, ports, token)


def secret(proxy: Proxy) -> str:
    """The hash of a proxy's token. Only the controller has the token."""
    environment = [str(variable) for variable in inspect(proxy.name)["Config"]["Env"]]
    assert not [
        variable for variable in environment if variable.startswith("ROSPROXY_ADMIN_TOKEN=")
    ]
    return next(
        variable for variable in environment if variable.startswith("ROSPROXY_ADMIN_TOKEN_HASH=")
    )


def test_missing_image_is_told_with_what_to_do(
    start_controller: Callable[..., Controller], net: Inside
) -> None:
    controller = start_controller("--proxy-image", "rosproxy:nosuch")
    net.idle(net.network())

    wait_until(lambda: "rosproxy:nosuch" in controller.problems(), 60, controller.logs)

    assert "docker build" in controller.problems() or "docker pull" in controller.problems()
    assert not managed("proxy")


def test_data_plane_of_the_controller_is_for_those_who_ask_for_none(
    start_controller: Callable[..., Controller], net: Inside, named: Robot
) -> None:
    start_controller("--data-plane", "kernel", "--ports", "12")
    network = net.network()
    with traffic(net, named, network, "rospy") as flow:
        wait_forwarded(flow)
        former = inspect(the_proxy().sandbox)["Id"]
        ports = the_proxy().ports
        changed = time.time()

        net.idle(network, labels=(ENABLE, "rosproxy.data-plane=copy"))

        copying = "ROSPROXY_DATA_PLANE=copy"
        wait_until(lambda: copying in variables(the_proxy()), 60, lambda: docker("ps", "--all"))
        flow.wait(since=time.time())
        print(f"from kernel to copy: {flow.gaps(changed)}")
        assert not inspect(the_proxy().name)["HostConfig"]["CapAdd"]
        assert inspect(the_proxy().sandbox)["Id"] != former, "no rules are left behind"
        assert the_proxy().ports == ports


def variables(proxy: Proxy) -> list[str]:
    environment: list[str] = inspect(proxy.name, check=False).get("Config", {}).get("Env", [])
    return environment
