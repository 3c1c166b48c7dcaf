"""The output of the controller's commands and of its HTTP endpoint."""

import urllib.request
from urllib.error import HTTPError

import pytest

from tests.docker.controller import Controller, the_proxy
from tests.docker.engine import docker, inspect, logs, wait_until
from tests.docker.inside import ENABLE, Inside
from tests.docker.robot import Robot

ADMIN = "http://127.0.0.1:21313"


def get(path: str) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(ADMIN + path, timeout=5) as reply:
            return reply.status, reply.read().decode()
    except HTTPError as error:
        return error.code, error.read().decode()


def test_status_shows_containers_proxies_nodes_and_problems(
    controller: Controller, net: Inside, named: Robot
) -> None:
    network = net.network()
    node = net.node(network, "rospy", "pub", "--topic", "/out")
    bad = net.idle(network, labels=(ENABLE, "rosproxy.ports=many"))
    wait_until(lambda: named.knows_proxied(node.node), 60, node.log.read)
    proxy = the_proxy()

    text = controller.command("status", check=False)

    for expected in (node.name, proxy.name, f"{proxy.ports[0]}-{proxy.ports[-1]}", f"/{node.node}",
                 bad.name, "rosproxy.ports"):  # fmt: skip
        assert expected in text, text

    status = controller.status()
    (proxy_status,) = status["proxies"]
    assert proxy_status["name"] == proxy.name
    assert proxy_status["master_uri"] == named.master_uri
    assert proxy_status["master_address"] == named.address
    assert proxy_status["master_up"]
    (container,) = (row for row in status["containers"] if row["name"] == node.name)
    assert container["proxy"] == proxy.name
    assert container["nodes"][0]["names"] == [f"/{node.node}"]
    assert container["nodes"][0]["advertised_uri"] == named.uri(node.node)
    assert status["actions"] == []


def test_health_and_metrics(controller: Controller, net: Inside) -> None:
    net.idle(net.network())
    the_proxy()

    assert get("/healthz")[0] == 200
    wait_until(lambda: get("/readyz")[0] == 200, 60, lambda: get("/readyz")[1])
    code, text = get("/metrics")
    assert code == 200
    for name in ("rosproxy_operator_", "process_cpu_seconds_total"):
        assert name in text
    assert get("/nosuch")[0] == 404


def test_controller_image_is_healthy_by_its_own_check(controller: Controller) -> None:
    docker("exec", controller.container, "env", f"ROSPROXY_ADMIN_BIND={ADMIN[7:]}",
           "rosproxy-operator", "health")  # fmt: skip

    with pytest.raises(AssertionError, match="exit 1"):
        docker("exec", controller.container, "rosproxy-operator", "health")


def test_controller_image(controller_image: str) -> None:
    config = inspect(controller_image)["Config"]
    assert config["User"] == "10001:10001"
    assert config["Entrypoint"] == ["rosproxy-operator"]
    assert config["Cmd"] == ["docker"]
    assert not config.get("ExposedPorts")
    assert "health" in " ".join(config["Healthcheck"]["Test"])
    listing = ("--entrypoint", "ls", controller_image, "/opt/rosproxy/bin")
    assert "pip" not in docker("run", "--rm", *listing).split()


def test_controller_stops_at_once(controller_image: str, container_name: str) -> None:
    docker("run", "--detach", "--name", container_name, "--network", "host",
           "--volume", "/var/run/docker.sock:/var/run/docker.sock", "--user", "0:0",
           controller_image, "docker", "--admin-bind", "127.0.0.1:21314",
)  # fmt: skip
    wait_until(lambda: "21314" in logs(container_name), 60, "the admin endpoint is logged")

    docker("stop", "--time", "10", container_name)

    assert inspect(container_name)["State"]["ExitCode"] == 0
