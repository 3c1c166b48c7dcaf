"""What a host's status says where a labelled container gets no proxy."""

from dataclasses import replace

from rosproxy.leases.ports import PortRange
from rosproxy_operator.docker.host_document import host_document
from rosproxy_operator.docker.planner.report import render
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.docker.settings import PlanSettings
from tests.unit.operator.docker.builders import HERE, SETTINGS, container, observed, planned

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
