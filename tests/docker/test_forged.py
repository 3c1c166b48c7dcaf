"""An image cannot pass for a proxy, or get more than the administrator allows."""

from collections.abc import Iterator

import pytest

from tests.docker.controller import Controller, Proxy, proxies, published_ranges, the_proxy
from tests.docker.engine import docker, inspect, wait_until
from tests.docker.inside import ENABLE, Container, Inside, unique

OPTIONS = ("--max-ports", "8")


@pytest.fixture
def proxy(controller: Controller, net: Inside) -> Proxy:
    """The proxy of a container."""
    network = net.network()
    net.idle(network)
    own_proxy = the_proxy()
    wait_until(lambda: network in own_proxy.networks, 60, "the proxy has joined the network")
    return own_proxy


@pytest.fixture(params=["sandbox", "proxy"])
def forged_image(request: pytest.FixtureRequest, proxy: Proxy, ros_image: str) -> Iterator[str]:
    """An image with every property of a proxy's container that an image can have."""
    tag = unique("image")
    made = docker("create", ros_image, "true")
    name = proxy.sandbox if request.param == "sandbox" else proxy.name
    changes = [f'LABEL {key}="{value}"' for key, value in inspect(name)["Config"]["Labels"].items()]
    changes += ["USER 10001:10001", 'ENTRYPOINT ["sleep"]', 'CMD ["infinity"]']
    try:
        docker(
            "commit",
            *(argument for change in changes for argument in ("--change", change)),
            made,
            tag,
        )
        yield tag
    finally:
        docker("rm", made)
        docker("rmi", "--force", tag, check=False)


def test_image_with_the_labels_of_a_proxy_is_told_and_left_alone(
    controller: Controller, net: Inside, proxy: Proxy, forged_image: str
) -> None:
    before = (proxy.id, inspect(proxy.sandbox)["Id"])
    ports = proxy.ports
    alone = net.network()
    joined = net.network()
    forged = net.run(alone, image=forged_image, labels=(), uri="")
    wait_until(lambda: forged.name in controller.problems(), 60, controller.logs)
    text = next(line for line in controller.problems().splitlines() if forged.name in line)
    assert "the name is not rosproxy-robot-" in text
    assert f"docker rm -f {forged.name}" in text

    net.idle(joined)
    wait_until(lambda: joined in proxy.networks, 60, "the proxy has joined another network")
    docker("rm", "--force", proxy.name)
    wait_until(lambda: proxy.running, 60, lambda: docker("ps", "--all"))

    assert (inspect(proxy.sandbox)["Id"], proxy.ports) == (before[1], ports)
    inspection = inspect(forged.name)
    assert inspection["State"]["Running"]
    assert inspection["RestartCount"] == 0
    assert set(inspection["NetworkSettings"]["Networks"]) == {alone}
    assert inspect(proxy.name)["HostConfig"]["NetworkMode"] == f"container:{before[1]}"


def test_labels_get_no_more_than_the_administrator_allows(
    controller: Controller, net: Inside
) -> None:
    network = net.network()
    labels = (ENABLE, "rosproxy.ports=9", "rosproxy.data-plane=kernel")
    greedy = net.idle(network, labels=labels)

    wait_until(
        lambda: [len(ports) for ports in published_ranges()] == [8], 60, controller.logs
    )  # fmt: skip

    assert not inspect(the_proxy().name)["HostConfig"]["CapAdd"]
    told = [line for line in controller.problems().splitlines() if greedy.name in line]
    bounds = {"ports=9": "--max-ports 9", "data-plane=kernel": "--allow-data-plane kernel"}
    for label, option in bounds.items():
        assert any(f"label rosproxy.{label}" in line and option in line for line in told), told


def test_label_takes_no_name_of_a_server_of_others(controller: Controller, net: Inside) -> None:
    network = net.network()
    uri = "http://api.example.com:443"
    node = net.idle(network, uri="", labels=(ENABLE, f"rosproxy.master-uri={uri}"))

    wait_until(lambda: node.name in controller.problems(), 60, controller.logs)

    assert "--allow-master api.example.com:443" in controller.problems()
    assert not [proxy for proxy in proxies() if network in proxy.networks]
    assert node.resolve("api.example.com") == set()


def test_proxy_is_bounded_and_has_no_token_and_its_controller_knows_it_anyway(
    controller: Controller, net: Inside, proxy: Proxy
) -> None:
    inspection = inspect(proxy.name)
    before = proxy.id
    host = inspection["HostConfig"]
    assert (host["Memory"], host["PidsLimit"]) == (1024**3, 8192)
    names = {variable.partition("=")[0] for variable in inspection["Config"]["Env"]}
    assert "ROSPROXY_ADMIN_TOKEN_HASH" in names
    assert "ROSPROXY_ADMIN_TOKEN" not in names

    controller.kill()
    controller.start()
    network = net.network()
    net.idle(network)

    wait_until(lambda: network in proxy.networks, 60, controller.logs)
    assert proxy.id == before
    assert "HTTP 403" not in controller.logs()


SERVER = ("python3", "-m", "http.server", "5432")
_URL = "http://db:5432/"
ASK = (
    *("python3", "-c"),
    f"import urllib.request as r; print(r.urlopen('{_URL}', timeout=5).headers['Server'])",
)


@pytest.fixture
def claimed(net: Inside) -> str:
    """A network on which a label wants the name db, which leads to a container elsewhere."""
    net.idle(net.network(), labels=(), options=("--network-alias", "db"))
    return net.network()


def claim(net: Inside, network: str) -> Proxy:
    """Start a container with db as the master in its label. Return the proxy on the network."""
    net.idle(network, uri="", labels=(ENABLE, "rosproxy.master-uri=http://db:5432"))
    wait_until(lambda: bool(on(network)), 60, lambda: docker("ps", "--all"))
    return on(network)[0]


def on(network: str) -> list[Proxy]:
    """The proxies on a network."""
    return [proxy for proxy in proxies() if network in proxy.networks]


def assert_reached(net: Inside, network: str, server: Container, proxy: Proxy) -> None:
    """Assert that db leads a third container to the server alone, and rosproxy to the proxy."""
    client = net.idle(network, labels=())
    own = {server.address(network)}
    wait_until(lambda: client.resolve("db") == own, 60, lambda: str(proxy.aliases(network)))
    wait_until(lambda: "SimpleHTTP" in client.run(*ASK, check=False), 30, server.name)
    assert client.resolve("rosproxy") == {proxy.address(network)}


def test_label_leaves_a_container_that_comes_later_its_name(
    controller: Controller, net: Inside, claimed: str
) -> None:
    proxy = claim(net, claimed)
    assert "db" in proxy.aliases(claimed)

    server = net.run(claimed, *SERVER, labels=(), options=("--network-alias", "db"))

    assert_reached(net, claimed, server, proxy)
    assert proxy.running


def test_label_leaves_a_stopped_container_its_name(
    controller: Controller, net: Inside, claimed: str
) -> None:
    server = net.run(claimed, *SERVER, labels=(), options=("--network-alias", "db"))
    docker("stop", "--time", "0", server.name)

    proxy = claim(net, claimed)

    assert "db" not in proxy.aliases(claimed)
    docker("start", server.name)
    assert_reached(net, claimed, server, proxy)
