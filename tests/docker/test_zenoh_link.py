"""A label links containers of rmw_zenoh to another site, with certificates of the host."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.certificates import Authority
from tests.docker.controller import Controller, remove_proxies, running_controller, the_proxy
from tests.docker.engine import inspect, wait_until
from tests.docker.inside import ENABLE, Inside, inside, unique
from tests.docker.machines import addresses, machine
from tests.docker.zenoh import NODE, Cloud, Node

NUMBER = 94
_, ADDRESS = addresses(NUMBER)
LINK = f"tls/{ADDRESS}:7447"
GOT = "got hello "


@pytest.fixture(scope="module")
def authority() -> Authority:
    return Authority()


@pytest.fixture(scope="module")
def files(authority: Authority, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory of the host with the certificate of its site."""
    return authority.write(tmp_path_factory.mktemp("link") / "host")


@pytest.fixture(scope="module")
def cloud(
    authority: Authority, proxy_image: str, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Cloud]:
    """The proxy of the other site, and a subscriber beside it."""
    there = authority.write(tmp_path_factory.mktemp("cloud") / "cloud", ADDRESS)
    with machine(proxy_image, "cloud", NUMBER, *Cloud.options(there)) as made:
        cloud = Cloud(made.start, made.root)
        cloud.start_proxy()
        yield cloud


@pytest.fixture(scope="module")
def controller(
    controller_image: str, proxy_image: str, files: Path, _no_other_controller: None
) -> Iterator[Controller]:
    options = ("--allow-link", f"tls/{ADDRESS}", "--zenoh-link-certificates", str(files))
    try:
        with running_controller(
            controller_image, "--proxy-image", proxy_image, *options, names={}
        ) as started_controller:
            yield started_controller
    finally:
        remove_proxies()


@pytest.fixture
def made(zenoh_image: str, controller: Controller) -> Iterator[Inside]:
    with inside(zenoh_image, "") as made:
        yield made


def node(made: Inside, network: str, kind: str, topic: str, *labels: str) -> Node:
    name = unique(kind)
    container = made.run(network, *NODE, kind, name, topic, name=name, labels=(ENABLE, *labels))
    return Node(name, container.log, container)


def problems(controller: Controller) -> str:
    rows = controller.status()["proxies"]
    return "\n".join(text for row in rows for text in row["problems"])


def test_a_label_links_the_host_to_another_site(
    made: Inside, controller: Controller, cloud: Cloud, authority: Authority, files: Path
) -> None:
    network = made.network()
    label = f"rosproxy.zenoh-link={LINK}"
    in_cloud = cloud.node("listener", "sub", "chatter")
    cloud.node("talker", "pub", "map")
    node(made, network, "pub", "chatter", label)
    back = node(made, network, "sub", "map")
    in_cloud.wait_for(GOT)
    back.wait_for(GOT)
    (row,) = controller.status()["proxies"]
    assert row["links"] == {LINK: True}
    assert controller.status()["problems"] == []
    proxy = the_proxy()
    made_as = inspect(proxy.name)
    (mount,) = made_as["HostConfig"]["Mounts"]
    assert (mount["Source"], mount["ReadOnly"]) == (str(files), True)
    assert not inspect(proxy.sandbox)["HostConfig"]["PortBindings"]
    assert f"zenoh link {LINK}: linked" in controller.command("doctor", check=False)

    # A certificate of another CA ends the link, and the right one brings it back. The proxy stays.
    Authority("another CA").write(files)
    (files / "ca.crt").write_bytes(authority.pem)
    told = "refuses the certificate of this proxy"
    wait_until(lambda: told in problems(controller), 60, lambda: problems(controller))
    authority.write(files)
    in_cloud.wait_for(GOT)
    wait_until(lambda: not problems(controller), 60, lambda: problems(controller))
    assert inspect(proxy.name)["Id"] == made_as["Id"]


def test_a_label_makes_no_link_that_is_not_allowed(
    made: Inside, controller: Controller, cloud: Cloud
) -> None:
    refused = "rosproxy.zenoh-link=tls/192.0.2.7:7447"
    talker = node(made, made.network(), "pub", "chatter", refused)
    assert talker.container

    def is_told() -> bool:
        return "--allow-link tls/192.0.2.7:7447" in controller.problems()

    wait_until(is_told, 30, controller.problems)
    wait_until(lambda: bool(controller.status()["proxies"]), 30, controller.problems)
    assert all("192.0.2.7" not in str(row["links"]) for row in controller.status()["proxies"])
