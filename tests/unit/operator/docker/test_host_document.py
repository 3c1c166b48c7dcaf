"""What a host's status says where a labelled container gets no proxy."""

from dataclasses import replace

import pytest

from rosproxy.admin.status_document import ProxyStatus
from rosproxy.leases.ports import PortRange
from rosproxy_operator.docker.host_document import host_document
from rosproxy_operator.docker.planner.model import Key
from rosproxy_operator.docker.planner.report import render
from rosproxy_operator.docker.planner.specs import proxy_name
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.docker.settings import PlanSettings
from tests.unit.operator.docker.builders import (
    HERE,
    KEY,
    SETTINGS,
    container,
    observed,
    planned,
    proxy,
)

TIGHT = PlanSettings(advertise_host=HERE, ports=2, port_window=PortRange(11400, 11401))


def test_a_labelled_container_without_a_proxy_is_listed() -> None:
    """Its window is too small: that is the problem, and not that nobody has a label."""
    state = observed(container(), listening=[11400])
    made = planned(state, TIGHT, DockerMemory(), 0.0)
    assert not made.actions
    status = host_document(state, made, made.problems, {}, TIGHT)
    (row,) = status["containers"]
    assert (row["name"], row["proxy"]) == ("talker", None)
    text = render({**status, "operator": None}, 120)
    assert "No container is labelled" not in text
    assert "--port-window" in text


def test_a_container_whose_master_is_refused_is_listed() -> None:
    settings = replace(SETTINGS, allow_master=("arm:*",))
    state = observed(container())
    made = planned(state, settings, DockerMemory(), 0.0)
    (row,) = host_document(state, made, made.problems, {}, settings)["containers"]
    assert (row["name"], row["proxy"]) == ("talker", None)


@pytest.mark.parametrize(("key", "up"), [(KEY, False), (Key("", HERE, 0), None)])
def test_only_a_proxy_for_ros_1_has_a_master(key: Key, up: bool | None) -> None:
    """What a proxy for ROS 2 says of one is nothing that is wrong."""
    running = proxy(KEY)
    own = replace(running.container, name=proxy_name(key))
    state = observed(proxies=[replace(running, key=key, container=own)])
    made = planned(state, SETTINGS, DockerMemory(), 0.0)
    answers = {proxy_name(key): ProxyStatus()}
    (row,) = host_document(state, made, (), answers, SETTINGS)["proxies"]
    assert (row["reachable"], row["master_up"]) == (True, up)
