"""Proxies that carry the way outwards, too: label, option, internal networks."""

from dataclasses import replace

import pytest
from msgspec import structs

from rosproxy.shared.setting_kinds import Direction
from rosproxy_operator.docker.planner.actions import Create
from rosproxy_operator.docker.planner.model import Container, Network
from rosproxy_operator.docker.planner.specs import container_config, proxy_fingerprint
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.proxy_spec.spec import ProxySpec
from tests.unit.operator.docker.builders import (
    APP,
    ENABLED,
    IMAGE,
    PLACE,
    RANGE,
    SECRET,
    SETTINGS,
    UPLINK,
    container,
    observed,
    planned,
    read_members,
)

LABEL = "rosproxy.direction"
CELL = Network("n2", "cell", internal=True)
PROXY = Create("p", PLACE, RANGE, "s")


def labelled(name: str, direction: str, network: str = "app", state: str = "running") -> Container:
    return container(name, {**ENABLED, LABEL: direction}, [network], state)


def inside(name: str) -> Container:
    return container(name, networks=["cell"])


def direction_of(
    *containers: Container, option: Direction = "out", now: float = 0.0, memory: DockerMemory
) -> Direction:
    seen = observed(*containers, networks=[UPLINK, APP, CELL])
    plan = planned(seen, replace(SETTINGS, direction=option), memory, now)
    made = [action.spec.direction for action in plan.actions if isinstance(action, Create)]
    assert made in ([], [plan.desired[0].spec.direction])
    return plan.desired[0].spec.direction


@pytest.mark.parametrize(
    ("containers", "option", "gets"),
    [
        ([container("a")], "out", "out"),
        ([container("a")], "both", "both"),
        ([labelled("a", "Both ")], "out", "both"),
        ([labelled("a", "out")], "both", "out"),
        ([labelled("a", "out"), container("b")], "both", "both"),
        ([labelled("a", "out"), labelled("b", "both")], "out", "both"),
        ([inside("a")], "out", "both"),
        ([inside("a"), container("b")], "out", "both"),
        ([labelled("a", "out", "cell")], "out", "out"),
        ([container("a", networks=["app", "cell"])], "out", "both"),
    ],
)
def test_who_asks(containers: list[Container], option: Direction, gets: str) -> None:
    assert direction_of(*containers, option=option, memory=DockerMemory()) == gets


def test_the_network_that_the_label_names_is_what_counts() -> None:
    """The container is on two networks, and the label names the network with a route."""
    labels = {**ENABLED, "rosproxy.network": "app"}
    on_both = container("a", labels, ["app", "cell"])
    assert direction_of(on_both, memory=DockerMemory()) == "out"


def test_a_direction_that_can_not_be() -> None:
    members, (problem,) = read_members(observed(labelled("a", "inwards")))
    assert members == ()
    assert problem.message.startswith("label rosproxy.direction='inwards' is none of out, both.")


def test_an_exited_container_keeps_the_direction_for_the_grace() -> None:
    """Otherwise a container's restart would recreate the proxy twice."""
    seen = observed(container("a"), labelled("b", "both", state="exited"))
    first = planned(seen, SETTINGS, DockerMemory(), 0.0)
    assert first.desired[0].spec.direction == "both"
    assert first.again_in is not None
    later = planned(seen, SETTINGS, first.memory, 60.0)
    assert later.desired[0].spec.direction == "out"


@pytest.mark.parametrize("direction", ["out", "both"])
def test_the_proxy_is_told(direction: Direction) -> None:
    body = container_config(
        structs.replace(PROXY, spec=ProxySpec(direction=direction)), SETTINGS, "t", ""
    )
    told = [pair for pair in body["Env"] if pair.startswith("ROSPROXY_DIRECTION=")]
    assert told == ([] if direction == "out" else ["ROSPROXY_DIRECTION=both"])


def test_another_direction_makes_a_proxy_anew() -> None:
    digests = {
        proxy_fingerprint(
            structs.replace(PROXY, spec=ProxySpec(direction=direction)), SETTINGS, IMAGE, SECRET
        )
        for direction in ("out", "both")
    }
    assert len(digests) == 2
