"""The custom resource definition, compared with what the operator reads and writes."""

from collections.abc import Iterator
from typing import Any

import pytest
from scripts.custom_resource_docs import custom_resource

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.policy.rules import LONGEST_GLOB
from rosproxy.shared.ports import PortRange
from rosproxy.shared.settings import MOST_ZENOH_LIMITS, MOST_ZENOH_LINKS
from rosproxy_operator.common.policy import MOST_RULES_OF_AUTHOR
from rosproxy_operator.kubernetes.resources import names
from rosproxy_operator.kubernetes.resources.cluster import (
    Obstacle,
    ProxyPod,
    ProxyReport,
    RosProxyOnNode,
    ZenohReport,
)
from rosproxy_operator.kubernetes.resources.model import Name, Pod
from rosproxy_operator.kubernetes.resources.spec import (
    MOST_LINK_RULES,
    MOST_NAME_CHARACTERS,
    MOST_PORTS,
    RULE_KINDS,
    rosproxy,
)
from rosproxy_operator.kubernetes.status.rosproxy_status import Addresses, status_of
from rosproxy_operator.proxy_spec.spec import OWN_SPEC, WISHES, words
from tests.chart.chart import Json

DEFINITION = custom_resource()
VERSION = DEFINITION["spec"]["versions"][0]
SCHEMA = VERSION["schema"]["openAPIV3Schema"]
BOUNDS = {"string": ("maxLength", "enum"), "array": ("maxItems",), "object": ("properties",
          "maxProperties"), "integer": ("format", "maximum"), "boolean": ("type",)}  # fmt: skip


def fields(schema: Json, path: str = "") -> Iterator[tuple[str, Json]]:
    """Every field below a schema, items of lists and values of maps too."""
    for name, field in schema.get("properties", {}).items():
        yield f"{path}.{name}", field
        yield from fields(field, f"{path}.{name}")
    for keyword in ("items", "additionalProperties"):
        if keyword in schema:
            yield f"{path}[]", schema[keyword]
            yield from fields(schema[keyword], f"{path}[]")


SPEC = dict(fields(SCHEMA["properties"]["spec"], "spec"))
STATUS = dict(fields(SCHEMA["properties"]["status"], "status"))


def test_names_are_the_operators() -> None:
    spec = DEFINITION["spec"]
    assert f"{spec['group']}/{VERSION['name']}" == names.API_VERSION
    assert spec["names"]["plural"] == names.PLURAL
    assert spec["names"]["kind"] == names.KIND
    assert spec["names"]["shortNames"] == ["rp"]
    assert VERSION["subresources"] == {"status": {}}


@pytest.mark.parametrize("path", [*SPEC, *STATUS])
def test_described(path: str) -> None:
    field = {**SPEC, **STATUS}[path]
    simple = path.endswith("[]") and field.get("type") != "object"
    assert simple or field["description"].endswith((".", "`"))


@pytest.mark.parametrize("path", SPEC)
def test_bounded(path: str) -> None:
    """The API server estimates the cost of a validation rule from the largest value of a field."""
    field = SPEC[path]
    if "x-kubernetes-int-or-string" in field:
        return
    bounds = BOUNDS.get(field["type"], ())
    assert any(bound in field for bound in bounds), f"{path} needs one of {bounds}"


@pytest.mark.parametrize("path", SPEC)
def test_a_number_or_text_is_structural(path: str) -> None:
    """The API server refuses a definition that has ``type`` and more in ``anyOf``."""
    alternatives = SPEC[path].get("anyOf", [])
    types = [{"type": "integer"}, {"type": "string"}]
    assert alternatives in ([], types) or all("type" not in each for each in alternatives)


def test_columns_show_fields() -> None:
    for column in VERSION["additionalPrinterColumns"]:
        path = column["jsonPath"].partition("[")[0]
        assert path.startswith(".metadata.") or path[1:] in STATUS, path
    always = [
        column["name"]
        for column in VERSION["additionalPrinterColumns"]
        if not column.get("priority")
    ]
    assert always == ["Master", "Domain", "Nodes", "Proxies", "Ready", "Age"]


def with_defaults(value: Any, schema: Json) -> Any:
    """An object with the defaults of the API server."""
    if not isinstance(value, dict):
        return value
    value = dict(value)
    for name, field in schema.get("properties", {}).items():
        if name not in value and "default" in field:
            value[name] = field["default"]
        if name in value:
            value[name] = with_defaults(value[name], field)
    return value


@pytest.mark.parametrize(
    "spec",
    [
        {"master": {"uri": "http://robot:11311"}},
        {"master": {"service": {"name": "master"}}},
        {"master": {"uri": "http://robot:11311"}, "portWindow": {"first": 20000}},
        {"master": {"uri": "http://robot:11311"}, "policy": {}, "resources": {}},
        {
            "master": {"uri": "http://robot:11311"},
            "policy": {"rules": [{"action": "Deny", "kind": "Call", "names": ["/a"]}]},
        },
    ],
)
def test_defaults_are_the_operators(spec: Json) -> None:
    """The operator reads an object without the API server's defaults in the same way."""
    bare = {"metadata": {"name": "a", "namespace": "b", "uid": "c", "generation": 1}, "spec": spec}
    completed = with_defaults(bare, SCHEMA)
    assert completed != bare
    assert rosproxy(completed) == rosproxy(bare)


def test_limits_are_the_operators() -> None:
    assert SPEC["spec.ports"]["maximum"] == MOST_PORTS
    assert f"size() <= {MOST_NAME_CHARACTERS}" in SCHEMA["x-kubernetes-validations"][0]["rule"]


@pytest.mark.parametrize("name", WISHES)
def test_options_of_a_proxy_are_the_operators(name: str) -> None:
    field = SPEC[f"spec.{WISHES[name].field}"]
    default = getattr(OWN_SPEC, name)
    assert field["default"] == (default.capitalize() if words(name) else default)
    assert field.get("enum", []) == [word.capitalize() for word in words(name)]


def test_bounds_of_a_policy_are_the_operators() -> None:
    """The operator can read everything that the API server accepts."""
    (rule,) = SPEC["spec.policy"]["x-kubernetes-validations"]
    assert f"<= {MOST_RULES_OF_AUTHOR}" in " ".join(rule["rule"].split())
    assert SPEC["spec.policy.rules[].kind"]["enum"] == [*RULE_KINDS]
    for path in ("spec.policy.rules[].names[]", "spec.policy.rules[].nodes[]"):
        assert SPEC[path]["maxLength"] == LONGEST_GLOB


def test_bounds_of_links_are_the_operators() -> None:
    assert SPEC["spec.link.to"]["maxItems"] == MOST_ZENOH_LINKS
    assert SPEC["spec.link.limits"]["maxItems"] == MOST_ZENOH_LIMITS
    assert SPEC["spec.link.policy"]["maxItems"] == MOST_LINK_RULES


def test_rules_have_messages() -> None:
    rules = [rule for schema in (SCHEMA, *SPEC.values(), SCHEMA["properties"]["spec"])
             for rule in schema.get("x-kubernetes-validations", [])]  # fmt: skip
    assert len(rules) > 12
    assert all(len(rule["message"].split()) >= 5 for rule in rules)


def test_status_is_in_the_definition() -> None:
    """The API server drops fields that the definition does not have, without a word."""
    body = {"metadata": {"name": "a", "namespace": "b", "uid": "c", "generation": 1},
            "spec": {"ros": "1,2", "master": {"uri": "http://robot:11311"}}}  # fmt: skip
    own = rosproxy(body)
    id = Name("b", "rosproxy-a-n-012345")
    ports = PortRange(11400, 11431)
    proxy = ProxyPod(Pod(id, "u"), own.id, "c", "n", "f", "rosproxy:1", range=ports, ready=True)
    pod = Pod(Name("b", "talker"), "v", node="n", ip="192.0.2.3")
    answer = ProxyReport(
        True,
        True,
        nodes={"192.0.2.3": ("/talker",)},
        topics=frozenset({"/chatter"}),
        participants={"192.0.2.3": ("01.0f.00.00.00.00.00.00.00.00.00.01",)},
    )
    stamp = "2026-01-01T00:00:00Z"
    states = (
        RosProxyOnNode("n", "192.0.2.1", ports, proxy, (pod,), answer, unregistered_at=stamp),
        RosProxyOnNode(
            "m", "192.0.2.2", None, None, (pod,), None, Obstacle("PortsExhausted", "no ports")
        ),
    )
    status = status_of(own, states, (), Addresses("192.0.2.9", "http://robot:11311"), stamp)
    link = {"to": ["tls/cloud"], "secretName": "link"}
    spec = {"ros": "zenoh", "listen": {"type": "NodePort"}, "link": link}
    zenoh = rosproxy({**body, "spec": spec})
    sites = {"tls/cloud:7447": ""}
    routers = ProxyReport(True, True, zenoh=ZenohReport(("/talker",), 1, sites=sites))
    of_zenoh = (RosProxyOnNode("n", "", ports, proxy, (pod,), routers),)
    addresses = Addresses("192.0.2.9", "", HostPort("192.0.2.1", 31000))
    other_status = status_of(zenoh, of_zenoh, (), addresses, stamp)
    written = {*paths(status, "status"), *paths(other_status, "status")}
    assert written <= set(STATUS)
    unused = {"status.perNode[].message", "status.conditions[].observedGeneration"}
    assert set(STATUS) - written <= unused


def paths(value: Any, path: str) -> Iterator[str]:
    """The fields of an object, in the words of `fields`."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield f"{path}.{name}"
            yield from paths(inner, f"{path}.{name}")
    elif isinstance(value, list | tuple):
        for inner in value:
            yield f"{path}[]"
            yield from paths(inner, f"{path}[]")
