"""The policy that each proxy gets."""

from typing import Any

import pytest
from msgspec.structs import replace

from rosproxy.shared.policy.layers import PolicyLayer
from rosproxy.shared.policy.rules import parse_rules
from rosproxy_operator.common.policy import administrators_policy
from tests.unit.operator.kubernetes.objects import (
    SETTINGS,
    done,
    look,
    node,
    observed,
    pod,
    proxy,
    rosproxy,
    service,
)

UID = "uid-proxy-robot-one"
OWN = PolicyLayer("RosProxy ros/robot", parse_rules("deny publish /camera/*"))
COMMON = administrators_policy([parse_rules("deny slave shutdown")], "enforce")
ALL = replace(SETTINGS, policy=COMMON)


@pytest.mark.parametrize(
    ("settings", "own", "told"),
    [
        (SETTINGS, (), ()),
        (SETTINGS, (OWN,), (OWN,)),
        (ALL, (), COMMON),
        (ALL, (OWN,), (*COMMON, OWN)),
    ],
)
def test_both_layers_are_told(settings: Any, own: Any, told: Any) -> None:
    seen = observed(rosproxy(policy=own), pod(), proxy())
    assert look(seen, settings=settings).briefings[UID].policy == told


def test_one_that_asks_for_too_much_keeps_its_policy() -> None:
    seen = observed(rosproxy(policy=(OWN,), image="evil:1"), pod(), proxy())
    assert look(seen, settings=ALL).briefings[UID].policy == (*COMMON, OWN)


@pytest.mark.parametrize("of", [(), (rosproxy(uid="other"),), (rosproxy(deleting=True),)])
def test_without_its_rosproxy_a_proxy_goes_on_with_what_it_knows(of: tuple[Any, ...]) -> None:
    assert look(observed(*of, node(), pod(), proxy())).briefings[UID].policy is None


def test_another_policy_makes_nothing_anew() -> None:
    of = rosproxy(policy=(OWN,))
    assert done(look(observed(of, service(of), pod(), proxy(rosproxy())), settings=ALL)) == []
