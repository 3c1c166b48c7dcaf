"""The controller's commands that look once and end: plan and --once."""

import json
from pathlib import Path

import pytest

from tests.docker.controller import Process, proxies, remove_proxies, the_proxy
from tests.docker.engine import docker
from tests.docker.inside import ENABLE, Inside
from tests.docker.robot import Robot


def everything() -> object:
    """The state of the engine, which a plan must not change."""
    containers = docker("ps", "--all", "--no-trunc", "--format", "{{json .}}").splitlines()
    columns = ("ID", "Names", "Networks", "State", "Labels")
    rows = [{key: row[key] for key in columns} for row in map(json.loads, containers)]
    return rows, docker("network", "ls", "--no-trunc", "--format", "{{.ID}} {{.Name}}")


@pytest.fixture
def process(tmp_path: Path, proxy_image: str, named: Robot, _no_other_controller: None) -> Process:
    options = ("--proxy-image", proxy_image)
    return Process(tmp_path, *options, names={named.name: named.address})


def test_plan_tells_and_changes_nothing(process: Process, net: Inside, named: Robot) -> None:
    node = net.idle(net.network())
    before = everything()

    text = process.once("plan", check=False)
    assert process.process is not None
    assert process.process.returncode == 3, "there is something to do"

    assert everything() == before
    assert named.master_uri in text
    assert "create" in text
    assert net.networks[0] in text
    assert node.state == "running"
    assert not proxies()


def test_once_does_it_and_says_whether_all_is_well(process: Process, net: Inside) -> None:
    network = net.network()
    net.idle(network)
    try:
        process.once("--once")
        number = the_proxy().id
        assert the_proxy().networks == {network}

        process.once("--once")
        assert the_proxy().id == number

        bad = net.idle(network, labels=(ENABLE, "rosproxy.ports=many"))
        text = process.once("--once", check=False)
        assert bad.name in text
        assert "rosproxy.ports" in text
        with pytest.raises(AssertionError, match="exit 1"):
            process.once("--once")
        assert the_proxy().id == number
    finally:
        remove_proxies()


def test_once_without_an_engine_fails_in_one_line(tmp_path: Path) -> None:
    environment = {"DOCKER_HOST": f"unix://{tmp_path}/nothing.sock"}
    process = Process(tmp_path, environment=environment)

    text = process.once("--once", check=False)

    assert "nothing.sock" in text
    assert len(text.splitlines()) == 1
    with pytest.raises(AssertionError, match="exit 1"):
        process.once("status")
