"""Proxies that publish UDP ports for UDPROS: label and option."""

from collections.abc import Mapping
from dataclasses import replace

import pytest
from msgspec import structs

from rosproxy.shared.ports import PortRange
from rosproxy_operator.docker.planner.actions import Create, CreateSandbox
from rosproxy_operator.docker.planner.model import Container
from rosproxy_operator.docker.planner.specs import (
    container_config,
    published_ports,
    sandbox_config,
    sandbox_fingerprint,
)
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.proxy_spec.spec import ProxySpec
from tests.unit.operator.docker.builders import (
    ENABLED,
    PLACE,
    RANGE,
    SETTINGS,
    container,
    observed,
    planned,
    read_members,
)

BOTH = {"rosproxy.direction": "both"}
ASKED = {"rosproxy.udp": "true"}
BOX = CreateSandbox("s", PLACE, PortRange(11400, 11401))


def labelled(name: str, *labels: Mapping[str, str]) -> Container:
    merged = dict(ENABLED)
    for addition in labels:
        merged |= addition
    return container(name, merged)


@pytest.mark.parametrize(
    ("containers", "option", "gets"),
    [
        ([labelled("a", BOTH)], False, False),
        ([labelled("a", BOTH, ASKED)], False, True),
        ([labelled("a", BOTH), labelled("b", ASKED)], False, True),
        ([labelled("a", BOTH)], True, True),
        ([labelled("a", BOTH, {"rosproxy.udp": "False"})], True, False),
        ([labelled("a", ASKED)], True, False),
    ],
)
def test_who_asks(containers: list[Container], option: bool, gets: bool) -> None:
    plan = planned(observed(*containers), replace(SETTINGS, udp=option), DockerMemory(), 0.0)
    made = [action for action in plan.actions if isinstance(action, Create | CreateSandbox)]
    assert [action.spec.udp for action in made] == [gets, gets]


def test_who_asks_for_it_alone_is_told() -> None:
    plan = planned(observed(labelled("a", ASKED)), SETTINGS, DockerMemory(), 0.0)
    (problem,) = plan.problems
    assert problem.subject == "container a"
    assert "rosproxy.direction=both" in problem.message
    assert not problem.fatal


def test_a_word_that_is_none() -> None:
    members, (problem,) = read_members(observed(labelled("a", {"rosproxy.udp": "yes"})))
    assert members == ()
    assert problem.message.startswith("label rosproxy.udp='yes' is neither true nor false")


@pytest.mark.parametrize("udp", [False, True])
def test_what_is_published_and_told(udp: bool) -> None:
    made = structs.replace(BOX, spec=ProxySpec(udp=udp))
    bindings = sandbox_config(made, SETTINGS)["HostConfig"]["PortBindings"]
    assert sorted(bindings) == sorted(
        f"{port}/{protocol}"
        for port in (11400, 11401)
        for protocol in (["tcp", "udp"] if udp else ["tcp"])
    )
    create = Create("p", PLACE, RANGE, "s", ProxySpec(udp=udp))
    told = container_config(create, SETTINGS, "t", "")["Env"]
    assert ("ROSPROXY_UDP=1" in told) == udp


def test_the_sandbox_is_made_anew_for_it() -> None:
    either = (structs.replace(BOX, spec=ProxySpec(udp=udp)) for udp in (False, True))
    assert len({sandbox_fingerprint(box, SETTINGS) for box in either}) == 2


@pytest.mark.parametrize(("udp", "first"), [({}, 11400), (ASKED, 11406)])
def test_udp_ports_that_others_have_are_in_the_way_of_those_that_ask(
    udp: Mapping[str, str], first: int
) -> None:
    taken = replace(container("dns", {}), udp_ports=frozenset({11402}))
    seen = replace(observed(labelled("a", BOTH, udp), taken), listening_udp=frozenset({11405}))
    plan = planned(seen, SETTINGS, DockerMemory(), 0.0)
    (box,) = [action for action in plan.actions if isinstance(action, CreateSandbox)]
    assert box.range.first == first
    published = published_ports(PLACE, box.range, box.spec.udp)
    assert len(published) == len(box.range) * (1 + box.spec.udp)
