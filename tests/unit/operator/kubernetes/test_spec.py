"""Parsing of RosProxies."""

import re
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.shared.policy.rules import RuleKind, format_rules, parse_rules
from rosproxy.shared.ports import PortRange
from rosproxy_operator.kubernetes.resources.fields import InvalidField
from rosproxy_operator.kubernetes.resources.model import Advertise, MasterSpec, Name, Selector
from rosproxy_operator.kubernetes.resources.spec import invalid, rosproxy
from tests.unit.operator.kubernetes.builders_api import NAMESPACE, rosproxy_obj


def test_the_least_that_one_needs_gets_the_defaults_of_the_crd():
    parsed = rosproxy(rosproxy_obj())

    assert (parsed.id, parsed.uid, parsed.generation) == (Name(NAMESPACE, "arm"), "uid-arm", 3)
    spec = parsed.spec
    assert spec.master == MasterSpec(uri="http://robot:11311")
    assert (spec.ports, spec.window) == (32, PortRange(11412, 29999))
    assert (spec.pod_selector, spec.node_selector, spec.tolerations) == (None, None, None)
    assert (spec.advertise, spec.proxy.slave_control) == (Advertise.INTERNAL_IP, "any")
    assert (spec.cleanup_after, spec.grace, spec.proxy.data_plane) == (30.0, 60.0, "auto")
    assert (spec.image, spec.image_pull_policy, spec.resources) == ("", "", None)
    assert (parsed.former_ranges, parsed.cluster_ip, parsed.deleting) == ({}, "", False)


def test_all_fields():
    spec = rosproxy(
        rosproxy_obj(
            {
                "master": {"service": {"name": "roscore"}, "publish": 31100},
                "ports": 8,
                "portWindow": {"first": 12000},
                "podSelector": {
                    "matchLabels": {"app": "ros"},
                    "matchExpressions": [
                        {"key": "example.org/tier", "operator": "In", "values": ["a", ""]},
                        {"key": "off", "operator": "DoesNotExist"},
                    ],
                },
                "nodeSelector": {"disk": "ssd"},
                "tolerations": [{"operator": "Exists"}],
                "advertise": "Hostname",
                "cleanupAfterSeconds": 0,
                "graceSeconds": 5,
                "policy": {"slaveControl": "Master"},
                "dataPlane": "Kernel",
                "logLevel": "Debug",
                "image": "rosproxy:2",
                "imagePullPolicy": "Never",
                "imagePullSecrets": [{"name": "pull"}],
                "resources": {"requests": {"cpu": 1}},
                "hostAliases": [{"ip": "192.0.2.7", "hostnames": ["Robot", "robot.example"]}],
            }
        )
    ).spec

    assert spec.master == MasterSpec(service=Name(NAMESPACE, "roscore"), publish=31100)
    assert (spec.ports, spec.window) == (8, PortRange(12000, 29999))
    assert spec.pod_selector == Selector(
        {"app": "ros"},
        (
            ("example.org/tier", "In", frozenset({"a", ""})),
            ("off", "DoesNotExist", frozenset()),
        ),
    )
    assert spec.node_selector == {"disk": "ssd"}
    assert spec.tolerations == ({"operator": "Exists"},)
    assert (spec.advertise, spec.proxy.slave_control) == (Advertise.HOSTNAME, "master")
    assert (spec.cleanup_after, spec.grace, spec.proxy.data_plane) == (0.0, 5.0, "kernel")
    assert (spec.image, spec.image_pull_policy) == ("rosproxy:2", "Never")
    assert spec.proxy.log_level == "debug"
    assert spec.image_pull_secrets == ({"name": "pull"},)
    assert spec.resources == {"requests": {"cpu": 1}}
    assert spec.host_aliases == ({"ip": "192.0.2.7", "hostnames": ["robot", "robot.example"]},)


@pytest.mark.parametrize(
    ("uri", "read"),
    [
        ("http://Robot:11311/", "http://robot:11311"),
        ("http://robot", "http://robot:11311"),
        ("http://robot/", "http://robot:11311"),
        ("http://robot:80/master/", "http://robot:80/master"),
        ("http://192.0.2.7:11311", "http://192.0.2.7:11311"),
        ("http://[fd00::1]", "http://[fd00::1]:11311"),
        (" http://robot:11311 ", "http://robot:11311"),
    ],
)
def test_masters(uri, read):
    assert rosproxy(rosproxy_obj({"master": {"uri": uri}})).spec.master.uri == read


def test_directions():
    def read(**spec):
        parsed = rosproxy(rosproxy_obj({"master": {"uri": "http://robot"}, **spec})).spec
        return parsed.proxy.direction, parsed.pod_egress, parsed.proxy.udp

    assert read() == ("out", "any", False)
    assert read(direction="Both") == ("both", "any", False)
    assert read(direction="Both", podEgress="Proxy", udp=True) == ("both", "proxy", True)
    with pytest.raises(InvalidField, match=r"spec\.podEgress.*direction: Both"):
        read(podEgress="Proxy")
    with pytest.raises(InvalidField, match=r"spec\.udp.*direction: Both"):
        read(udp=True)
    with pytest.raises(InvalidField, match=r"spec\.udp: 'yes' is not valid. Write true or false"):
        read(udp="yes")


def test_a_masters_address():
    master = {"uri": "http://robot:11311", "address": "192.0.2.7"}

    assert rosproxy(rosproxy_obj({"master": master})).spec.master.address == "192.0.2.7"


def test_what_the_status_holds():
    lines = [
        {"name": "node1", "ports": "11400-11431"},
        {"name": "node2"},
        {"name": "node3", "ports": "11431-11400"},
        "strange",
    ]

    parsed = rosproxy(
        rosproxy_obj(status={"masterURI": "http://10.96.7.7:11311", "perNode": lines})
    )

    assert parsed.former_ranges == {"node1": PortRange(11400, 11431)}
    assert parsed.cluster_ip == "10.96.7.7"
    assert parsed.status["perNode"] == lines


def test_one_that_is_being_deleted():
    obj = rosproxy_obj()
    obj["metadata"]["deletionTimestamp"] = "2026-11-21T14:00:00Z"

    assert rosproxy(obj).deleting


def _selector(key: str = "app", operator: str = "In", values: Any = ("a",)) -> dict[str, Any]:
    requirement: dict[str, Any] = {"key": key, "operator": operator}
    return {"podSelector": {"matchExpressions": [{**requirement, "values": list(values)}]}}


@pytest.mark.parametrize(
    ("spec", "field"),
    [
        ({"master": None}, "spec.master"),
        ({"master": "http://robot:11311"}, "spec.master"),
        ({"master": {"uri": "http://r:1", "service": {"name": "r"}}}, "spec.master"),
        ({"master": {"uri": 7}}, "spec.master.uri"),
        ({"master": {"uri": "robot:11311"}}, "spec.master.uri"),
        ({"master": {"uri": "https://robot:11311"}}, "spec.master.uri"),
        ({"master": {"uri": "http://robot:"}}, "spec.master.uri"),
        ({"master": {"uri": "http://robot:99999"}}, "spec.master.uri"),
        ({"master": {"uri": "http://"}}, "spec.master.uri"),
        ({"master": {"uri": "http://[::"}}, "spec.master.uri"),
        ({"master": {"uri": "http://localhost:11311"}}, "spec.master.uri"),
        ({"master": {"uri": "http://127.0.0.2"}}, "spec.master.uri"),
        ({"master": {"uri": "http://rosproxy-arm:11311"}}, "spec.master.uri"),
        ({"master": {"uri": "http://rosproxy-arm.robots:11311"}}, "spec.master.uri"),
        ({"master": {"uri": "http://rosproxy-arm.robots.svc.cluster.local"}}, "spec.master.uri"),
        ({"master": {"uri": "http://r:1", "address": "robot"}}, "spec.master.address"),
        ({"master": {"uri": "http://r:1", "address": "::1"}}, "spec.master.address"),
        ({"master": {"service": {"name": "r"}, "address": "192.0.2.7"}}, "spec.master.address"),
        ({"master": {"service": {"name": "r"}, "publish": 80}}, "spec.master.publish"),
        ({"master": {"service": {}}}, "spec.master.service.name"),
        ({"master": {"service": {"name": "rosproxy-arm"}}}, "spec.master.service.name"),
        ({"master": {"service": {"name": "r", "namespace": "a.b"}}}, "spec.master.service.namesp"),
        ({"master": {"service": {"name": "r", "port": 0}}}, "spec.master.service.port"),
        ({"ports": 0}, "spec.ports"),
        ({"ports": 501}, "spec.ports"),
        ({"ports": True}, "spec.ports"),
        ({"ports": "32"}, "spec.ports"),
        ({"portWindow": {"first": 80}}, "spec.portWindow.first"),
        ({"portWindow": {"first": 12000, "last": 12010}}, "spec.portWindow"),
        ({"portWindow": {"first": 12000, "last": 11999}, "ports": 1}, "spec.portWindow"),
        ({"portWindow": [1, 2]}, "spec.portWindow"),
        ({"podSelector": {"matchLabels": {"a b": "x"}}}, "spec.podSelector.matchLabels"),
        ({"podSelector": {"matchLabels": {"a": "x,y"}}}, "spec.podSelector.matchLabels.a"),
        ({"podSelector": {"matchLabels": {"a": 1}}}, "spec.podSelector.matchLabels.a"),
        (_selector(operator="Gt"), "spec.podSelector.matchExpressions[0].operator"),
        (_selector(key="/x"), "spec.podSelector.matchExpressions[0].key"),
        (_selector(key="A.b/x/y"), "spec.podSelector.matchExpressions[0].key"),
        (_selector(values=["a)"]), "spec.podSelector.matchExpressions[0].values[0]"),
        (_selector(values=[None]), "spec.podSelector.matchExpressions[0].values[0]"),
        (_selector(values=[]), "spec.podSelector.matchExpressions[0].values"),
        (_selector(operator="Exists"), "spec.podSelector.matchExpressions[0].values"),
        ({"nodeSelector": {"a": 1}}, "spec.nodeSelector.a"),
        ({"tolerations": ["x"]}, "spec.tolerations[0]"),
        ({"advertise": "Internal"}, "spec.advertise"),
        ({"cleanupAfterSeconds": -1}, "spec.cleanupAfterSeconds"),
        ({"graceSeconds": "1m"}, "spec.graceSeconds"),
        ({"policy": {"slaveControl": "any"}}, "spec.policy.slaveControl"),
        ({"dataPlane": "kernel"}, "spec.dataPlane"),
        ({"logLevel": "debug"}, "spec.logLevel"),
        ({"imagePullPolicy": "Maybe"}, "spec.imagePullPolicy"),
        ({"hostAliases": {"robot": "192.0.2.7"}}, "spec.hostAliases"),
        ({"hostAliases": [{"ip": "robot", "hostnames": []}]}, "spec.hostAliases[0].ip"),
        ({"hostAliases": [{"ip": "010.0.0.1"}]}, "spec.hostAliases[0].ip"),
        ({"hostAliases": [{"ip": "fe80::1%eth0"}]}, "spec.hostAliases[0].ip"),
        (
            {"hostAliases": [{"ip": "192.0.2.7", "hostnames": ["my_robot"]}]},
            "spec.hostAliases[0].hostnames[0]",
        ),
    ],
)
def test_what_can_not_be_used_is_told_by_its_field(spec, field):
    with pytest.raises(InvalidField, match=re.escape(field)) as error:
        rosproxy(rosproxy_obj(spec))

    assert ": " in str(error.value)
    assert len(str(error.value)) < 400


@pytest.mark.parametrize(
    ("spec", "text"),
    [
        ({"ports": 501}, "spec.ports: 501 is not valid. Write an integer from 1 to 500"),
        ({"ports": "32"}, "spec.ports: '32' is not valid. Write an integer"),
        ({"image": 7}, "spec.image: 7 is not valid. Write a text, in quotes"),
        (
            {"nodeSelector": {"a": 1}},
            "spec.nodeSelector.a: 1 is not valid. Write a text, in quotes",
        ),
        ({"portWindow": [1]}, "spec.portWindow: [1] is not valid. Write a map of fields"),
        ({"dataPlane": "kernel"}, "spec.dataPlane: 'kernel' is unknown. Write one of Auto, Copy, "),
        (
            {"graceSeconds": -1},
            "spec.graceSeconds: -1 is not valid. Write a number from 0 to 86400",
        ),
    ],
)
def test_the_fix_is_told(spec, text):
    with pytest.raises(InvalidField, match=re.escape(text)):
        rosproxy(rosproxy_obj(spec))


def test_null_is_as_if_it_were_not_given():
    assert rosproxy(rosproxy_obj({"ports": None, "podSelector": None})) == rosproxy(rosproxy_obj())


@pytest.mark.parametrize("name", ["a" * 47, "Arm", "arm.1", "", "-a"])
def test_names_that_are_no_part_of_a_host_name(name):
    with pytest.raises(InvalidField, match=re.escape("metadata.name")):
        rosproxy(rosproxy_obj(name=name))


def test_the_longest_name():
    assert rosproxy(rosproxy_obj(name="a" * 46)).id.name == "a" * 46


def test_what_is_left_of_one_that_can_not_be_used():
    obj = rosproxy_obj({"ports": 0}, status={"masterURI": "http://10.96.7.7:11311"})

    unusable = invalid(obj, InvalidField("spec.ports: 0"))

    assert (unusable.id, unusable.uid, unusable.generation) == (
        Name(NAMESPACE, "arm"),
        "uid-arm",
        3,
    )
    assert unusable.text == "spec.ports: 0"
    assert unusable.status == {"masterURI": "http://10.96.7.7:11311"}


_FIELDS = [
    *("master", "uri", "address", "service", "publish", "ports", "portWindow", "first", "last"),
    *("podSelector", "matchLabels", "matchExpressions", "key", "operator", "values", "advertise"),
    *("nodeSelector", "tolerations", "policy", "slaveControl", "cleanupAfterSeconds", "image"),
    *("dataPlane", "direction", "podEgress", "udp", "logLevel"),
    *("imagePullSecrets", "resources", "hostAliases", "ip", "hostnames"),
]
_json = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(["http://robot:11311", "http://[::1", "In", "app"]),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(_FIELDS) | st.text(max_size=3), inner, max_size=5)
    ),
    max_leaves=15,
)


def _refusal(obj: Any) -> str:
    """The reason of a refusal, or empty."""
    try:
        rosproxy(obj)
    except InvalidField as error:
        invalid(obj, error)
        return str(error)
    return ""


@given(_json)
def test_no_spec_is_too_strange_to_be_read_or_refused(spec):
    text = _refusal({**rosproxy_obj(), "spec": spec})

    assert not text or text.startswith("spec")


@given(st.dictionaries(st.sampled_from(_FIELDS), _json, min_size=1, max_size=3))
def test_a_bad_field_beside_good_ones(spec):
    text = _refusal(rosproxy_obj(spec))

    assert not text or text.startswith("spec.")


# its policy


def policy(*rules: Any, **more: Any) -> Any:
    return rosproxy(rosproxy_obj({"policy": {"rules": list(rules), **more}})).spec.policy


def rule(**changes: Any) -> dict[str, Any]:
    return {"action": "Deny", "kind": "Publish", "names": ["/camera/*"], **changes}


def test_rules_of_a_policy_are_one_layer():
    (layer,) = policy(
        rule(names=["/a", "/b"], nodes=["/x", "/y*"]),
        rule(action="Allow", kind="GetParam", names=["*"], nodes=[]),
        rule(kind="Slave", names=["shutdown"]),
        mode="Audit",
    )

    assert (layer.name, layer.mode.value, layer.addresses) == (
        f"RosProxy {NAMESPACE}/arm", "audit", None,
    )  # fmt: skip
    assert [str(r) for r in layer.rules] == [
        "deny publish /a by /x",
        "deny publish /a by /y*",
        "deny publish /b by /x",
        "deny publish /b by /y*",
        "allow get-param *",
        "deny slave shutdown",
    ]
    assert parse_rules(format_rules(layer.rules)) == layer.rules


def test_without_rules_there_is_no_layer():
    assert policy() == policy(mode="Audit") == rosproxy(rosproxy_obj()).spec.policy == ()


@pytest.mark.parametrize("kind", [rule_kind.value for rule_kind in RuleKind])
def test_every_kind_of_rule_has_a_word(kind):
    camel_case = "".join(segment.capitalize() for segment in kind.split("-"))
    assert policy(rule(kind=camel_case))[0].rules[0].kind.value == kind


@pytest.mark.parametrize(
    ("bad", "said"),
    [
        (rule(action="Hide"), "spec.policy.rules[0].action: 'Hide' is unknown. Write one of Allow"),
        (rule(kind="Topic"), "spec.policy.rules[0].kind: 'Topic' is unknown. Write one of Call"),
        (rule(kind=None), "spec.policy.rules[0].kind"),
        (rule(names=[]), "spec.policy.rules[0].names: [] is empty. Write the names"),
        (rule(names=["camera"]), "names[0]: 'camera' is not a pattern of names. Write 1 to 256"),
        (rule(names=["camera"]), "without blanks and ;, with /, * or ? at the beginning"),
        (rule(names=["/a; allow publish *"]), "is not a pattern of names"),
        (rule(names=["/a by /b"]), "is not a pattern of names"),
        (rule(names=["/" + "a" * 256]), "is not a pattern of names"),
        (rule(names=[""]), "is not a pattern of names"),
        (
            rule(nodes=["driver"]),
            "spec.policy.rules[0].nodes[0]: 'driver' is not a pattern of names",
        ),
        (rule(kind="Slave", names=["shutdown"], nodes=["x"]), "nodes[0]: 'x' is not a pattern"),
        (rule(names=["/a"] * 501), "spec.policy.rules: 501 rules, at most 500 are accepted"),
        (rule(names=["/" + "a" * 200] * 300), "bytes, at most 32768 are accepted. Join names"),
        (rule(names=["/" + "a" * 250] * 450), "bytes, at most 32768 are accepted. Join names"),
    ],
)
def test_a_bad_rule_is_told(bad, said):
    with pytest.raises(InvalidField, match=re.escape(said)):
        policy(bad)


def test_a_mode_that_can_not_be():
    with pytest.raises(InvalidField, match=re.escape("spec.policy.mode: 'Tell' is unknown")):
        policy(mode="Tell")
