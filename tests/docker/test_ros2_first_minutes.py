"""Settings of a container that lead past the proxy: what is told, followed word by word."""

import json
from collections.abc import Callable, Iterator

import pytest

from tests.docker.controller import Controller
from tests.docker.engine import docker, wait_until
from tests.docker.inside import ENABLE
from tests.docker.ros2 import OPTIONS, THERE, Inside2, Outside, wait_for_line

STATIC_PEERS = f"Unset the variable, and add the label rosproxy.peers='{THERE}'"
DISCOVERY_SERVER = "ROS_DISCOVERY_SERVER", "192.0.2.1:11811"
EXTERNAL_ADDRESS = (
    "CYCLONEDDS_URI",
    "<CycloneDDS><Domain><General><ExternalNetworkAddress>192.0.2.1</ExternalNetworkAddress>"
    "</General></Domain></CycloneDDS>",
)


@pytest.fixture(autouse=True)
def _nodes_end(lan: Outside) -> Iterator[None]:
    yield
    lan.end()


def names(controller: Controller, variable: str, fix: str) -> bool:
    """Whether a finding of the doctor names a variable, and what to do."""
    text = controller.command("doctor", "--json", check=False)
    findings = json.loads(text[text.index("{") :])["findings"]
    told = [f"{finding['text']}: {finding['fix']}" for finding in findings]
    return any(variable in text and fix in text for text in told)


@pytest.mark.parametrize(
    ("vendor", "name", "value", "fix"),
    [
        ("jazzy", "ROS_STATIC_PEERS", THERE, STATIC_PEERS),
        ("kilted", "ROS_STATIC_PEERS", THERE, STATIC_PEERS),
        ("cyclone", "ROS_STATIC_PEERS", THERE, STATIC_PEERS),
        ("jazzy", *DISCOVERY_SERVER, "Unset the variable"),
        ("jazzy", "ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF", "or set SUBNET"),
        ("jazzy", "FASTDDS_BUILTIN_TRANSPORTS", "SHM", "or set UDPv4"),
        ("cyclone", *EXTERNAL_ADDRESS, "use a network that the proxy shares"),
    ],
)
def test_a_setting_that_leads_past_the_proxy(
    vendor: str,
    name: str,
    value: str,
    fix: str,
    start_controller: Callable[..., Controller],
    lan: Outside,
    inside2: Inside2,
) -> None:
    """For ROS_STATIC_PEERS without the LAN's multicast, which static peers replace."""
    is_by_peers = fix == STATIC_PEERS
    controller = start_controller(*OPTIONS, *(("--ros2-lan", "none") if is_by_peers else ()))
    network = inside2.made.network()
    reader = lan.node("jazzy", "sub", "/out")
    node = inside2.node(network, vendor, "pub", "/out", options=("--env", f"{name}={value}"))

    wait_until(lambda: names(controller, name, fix), 60, controller.logs)
    assert "got hello" not in reader.log.read()

    docker("rm", "--force", node.name)
    written = fix.partition("or set ")[2]
    options = ("--env", f"{name}={written}") if written else ()
    labels = (ENABLE, f"rosproxy.peers={THERE}") if is_by_peers else (ENABLE,)
    inside2.node(network, vendor, "pub", "/out", options=options, labels=labels)
    wait_for_line(reader.log, "^got hello ")
    wait_until(lambda: controller.problems() == "", 20, controller.problems)
