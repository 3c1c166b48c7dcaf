"""Controllers with options of their own."""

from collections.abc import Callable

from tests.docker.controller import Controller, the_proxy
from tests.docker.engine import wait_until
from tests.docker.inside import Inside
from tests.docker.robot import Robot


def test_expose_by_default(start_controller: Callable[..., Controller], net: Inside) -> None:
    network, other = net.network(), net.network()
    net.idle(network, labels=())
    net.idle(other, labels=("rosproxy.enable=false",))
    start_controller("--expose-by-default")

    proxy = the_proxy()

    wait_until(lambda: proxy.networks == {network}, 10, lambda: str(proxy.networks))


def test_master_of_the_controller_serves_those_who_name_none(
    start_controller: Callable[..., Controller], net: Inside, named: Robot
) -> None:
    start_controller("--master-uri", named.master_uri, "--advertise-host", named.host_address)
    node = net.node(net.network(), "rospy", "pub", "--topic", "/out", uri="http://rosproxy:11311")

    wait_until(lambda: named.knows_proxied(node.node), 30, node.log.read)
