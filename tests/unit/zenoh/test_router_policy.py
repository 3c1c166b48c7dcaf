"""The policy at the ports for containers, and the names of nodes inside that it denies."""

from collections.abc import Sequence

import pytest

from rosproxy.access.access_policy import AccessPolicy
from rosproxy.shared.output.problems import Problems
from rosproxy.shared.policy.layers import PolicyLayer, PolicyMode
from rosproxy.shared.policy.rules import RuleKind, parse_rules
from rosproxy.shared.ports import PortRange
from rosproxy.telemetry.metrics import Metrics
from rosproxy.telemetry.refusals import Refusals
from rosproxy.zenoh import router_policy
from rosproxy.zenoh.access_control import access_control
from rosproxy.zenoh.router_policy import InsideName, RouterPolicy

FIRST = "172.18.0.3"
SECOND = "172.18.0.4"
PORTS = PortRange(7448, 7450)


def container_layer(rules: str, address: str, *ports: int) -> PolicyLayer:
    """The layer of a container, as the operator for Docker gives it."""
    return PolicyLayer(
        "label", parse_rules(rules), addresses=frozenset({address}), ports=frozenset(ports)
    )


def make(
    *layers: PolicyLayer, listen: int | None = None
) -> tuple[RouterPolicy, AccessPolicy, Metrics]:
    metrics = Metrics()
    refusals = Refusals(metrics, Problems(), lambda: 0.0)
    policy = AccessPolicy(layers, (), metrics, refusals)
    return RouterPolicy(policy, PORTS, listen), policy, metrics


def name(topic: str, port: int = 7448, kind: RuleKind = RuleKind.PUBLISH) -> InsideName:
    return InsideName(port, FIRST, "/driver", kind, topic)


def hidden(policy: RouterPolicy) -> list[tuple[str, str]]:
    return [(row.kind, row.name) for row in policy.hidden()[0]]


@pytest.mark.parametrize(
    ("layer", "ports"),
    [
        (PolicyLayer("common", parse_rules("deny publish /a")), [7448, 7449, 7450]),
        (container_layer("deny publish /a", FIRST, 7449), [7449]),
        (
            PolicyLayer("by hand", parse_rules("deny publish /a"), addresses=frozenset({FIRST})),
            [7448, 7449, 7450],  # the port of the container is unknown
        ),
    ],
)
def test_a_layer_holds_at_the_ports_of_its_containers(
    layer: PolicyLayer, ports: Sequence[int]
) -> None:
    policy, _, _ = make(layer)
    assert sorted(policy.access()) == ports


def test_rules_for_all_hold_at_the_port_for_outside_as_seen_from_there() -> None:
    common = PolicyLayer("common", parse_rules("deny publish /a"))
    policy, _, _ = make(common, container_layer("deny publish /b", FIRST, 7448), listen=7447)
    access = policy.access()
    assert sorted(access) == [7447, 7448, 7449, 7450]
    assert access[7447] == access_control([common], outside=True)
    assert access[7449] == access_control([common])
    policy, _, _ = make(container_layer("deny publish /b", FIRST, 7448), listen=7447)
    assert sorted(policy.access()) == [7448]


def test_rules_follow_an_address_to_other_ports_and_stay() -> None:
    policy, layers, _ = make()
    layers.use_operator_layers([container_layer("deny publish /a", FIRST, 7448)])
    assert sorted(policy.access()) == [7448]
    policy.note([(7450, FIRST), (7449, SECOND)])
    assert sorted(policy.access()) == [7448, 7450]
    policy.note([])
    assert sorted(policy.access()) == [7448, 7450]
    layers.use_operator_layers([container_layer("deny publish /a", SECOND, 7448)])
    policy.note([])
    assert sorted(policy.access()) == [7448]
    layers.use_operator_layers([])
    assert not policy.access()


def test_unchanged_layers_give_the_same_access() -> None:
    policy, layers, _ = make(container_layer("deny publish /a", FIRST, 7448))
    access = policy.access()
    policy.note([(7450, SECOND)])
    assert policy.access() is access
    layers.use_operator_layers([])
    assert policy.access() is not access


def test_a_denied_name_is_told_once() -> None:
    policy, layers, metrics = make(PolicyLayer("common", parse_rules("deny publish /a")))
    policy.access()
    names = [name("/a"), name("/b"), name("/a", kind=RuleKind.SUBSCRIBE)]
    for _ in range(3):
        policy.look(names)
    assert hidden(policy) == [("publish", "/a")]
    assert policy.hidden()[0][0].reason == "policy of common: deny publish /a"
    counted = metrics.policy_denied.labels("publish", "enforce")
    assert counted._value.get() == 1
    layers.use_operator_layers([PolicyLayer("more", parse_rules("deny publish /b"))])
    policy.access()
    policy.look(names)
    assert hidden(policy) == [("publish", "/a"), ("publish", "/b")]
    policy.look([])
    assert not hidden(policy)


def test_audit_tells_what_it_would_deny() -> None:
    layer = PolicyLayer("audit", parse_rules("deny publish /a"), PolicyMode.AUDIT)
    policy, _, metrics = make(layer)
    assert not policy.access()
    policy.look([name("/a")])
    assert not hidden(policy)
    assert metrics.policy_denied.labels("publish", "audit")._value.get() == 1


def test_names_are_judged_in_bounded_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(router_policy, "MOST_JUDGED_NAMES", 2)
    policy, _, _ = make(PolicyLayer("common", parse_rules("deny publish *")))
    policy.access()
    names = [name(f"/{number}") for number in range(5)]
    counts = []
    for _ in range(3):
        assert policy.not_judged(names) == {(7448, FIRST, "/driver")}
        policy.look(names)
        counts.append(len(hidden(policy)))
    assert counts == [2, 4, 5]
    assert not policy.not_judged(names)


def test_without_rules_no_name_waits_for_a_verdict() -> None:
    policy, _, _ = make(container_layer("deny publish /a", FIRST, 7449))
    policy.access()
    assert policy.not_judged([name("/a"), name("/a", 7449)]) == {(7449, FIRST, "/driver")}
