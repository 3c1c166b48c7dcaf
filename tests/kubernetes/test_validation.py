"""Refusals of the API server, with messages."""

from typing import Any

import pytest

from tests.kubernetes import api
from tests.kubernetes.pods import Namespace
from tests.kubernetes.rosproxies import rosproxy, rosproxy_body

GOOD = {"uri": "http://robot:11311"}
RULE = {"action": "Deny", "kind": "Publish", "names": ["/camera/*"]}
BAD: dict[str, tuple[dict[str, Any], str]] = {
    "no master": ({}, "master"),
    "empty master": ({"master": {}}, "exactly one of uri"),
    "both": ({"master": {**GOOD, "service": {"name": "x"}}}, "exactly one of uri"),
    "https": ({"master": {"uri": "https://robot:11311"}}, "http://host:11311"),
    "localhost": ({"master": {"uri": "http://localhost:11311"}}, "a loopback address"),
    "loopback": ({"master": {"uri": "http://127.0.0.1:11311"}}, "a loopback address"),
    "address": ({"master": {**GOOD, "address": "robot"}}, "IP address"),
    "no ports": ({"master": GOOD, "ports": 0}, "ports"),
    "many ports": ({"master": GOOD, "ports": 501}, "ports"),
    "small window": (
        {"master": GOOD, "portWindow": {"first": 12000, "last": 12010}},
        "fewer ports",
    ),
    "no window": ({"master": GOOD, "portWindow": {"first": 13000, "last": 12000}}, "above"),
    "advertise": ({"master": GOOD, "advertise": "Fixed"}, "advertise"),
    "selector": (
        {"master": GOOD, "podSelector": {"matchExpressions": [{"key": "a", "operator": "In"}]}},
        "need values",
    ),
    "no names": ({"master": GOOD, "policy": {"rules": [{**RULE, "names": []}]}}, "names"),
    "names of no topic": (
        {"master": GOOD, "policy": {"rules": [{**RULE, "names": ["camera"]}]}},
        "begin with /, * or ?",
    ),
    "two names in one": (
        {"master": GOOD, "policy": {"rules": [{**RULE, "names": ["/a;/b"]}]}},
        "names[0]",
    ),
    "nodes of no name": (
        {"master": GOOD, "policy": {"rules": [{**RULE, "nodes": ["driver"]}]}},
        "nodes[0]",
    ),
    "kind": ({"master": GOOD, "policy": {"rules": [{**RULE, "kind": "Topic"}]}}, "kind"),
    "many rules": (
        {
            "master": GOOD,
            "policy": {"rules": [{**RULE, "names": ["/a"] * 17, "nodes": ["/b"]}] * 30},
        },
        "rules are too many",
    ),
    "mode": ({"master": GOOD, "policy": {"mode": "Tell"}}, "mode"),
    "publish": ({"master": {**GOOD, "publish": 11302}}, "publish"),
    "ROS 3": ({"ros": 3}, 'ros is 1, 2 or "1,2", or zenoh'),
    "ROS 2 with a master": ({"ros": 2, "master": GOOD}, "ROS 2 has none"),
    "both versions without a master": ({"ros": "1,2"}, "ROS 1 needs a master"),
    "ROS 1 with a domain": ({"master": GOOD, "domain": 3}, "are for ROS 2"),
    "rmw_zenoh and others": ({"ros": "1,2,zenoh", "master": GOOD}, "in pods of their own"),
    "rmw_zenoh with a master": ({"ros": "zenoh", "master": GOOD}, "ROS 2 has none"),
    "rmw_zenoh with ports": ({"ros": "zenoh", "ports": 64}, "has no ports on the node"),
    "rmw_zenoh with a domain": ({"ros": "zenoh", "domain": 1}, "takes peers alone"),
    "ROS 2 with an IPv6 peer": ({"ros": 2, "peers": ["[fd00::7]"]}, "proxies for DDS have no IPv6"),
    "ROS 2 with a port for laptops": (
        {"ros": 2, "listen": {"type": "NodePort"}},
        "listen is for rmw_zenoh",
    ),
    "a port for laptops of no type": ({"ros": "zenoh", "listen": {}}, "type"),
    "a class without a load balancer": (
        {"ros": "zenoh", "listen": {"type": "NodePort", "loadBalancerClass": "a.example/b"}},
        "loadBalancerClass is for type: LoadBalancer",
    ),
    "ROS 2 with a link": (
        {"ros": 2, "link": {"to": ["tls/cloud"], "secretName": "a"}},
        "link is for rmw_zenoh",
    ),
    "a link without a certificate": ({"ros": "zenoh", "link": {"to": ["tls/cloud"]}}, "secretName"),
    "a link without TLS": (
        {"ros": "zenoh", "link": {"to": ["tcp/cloud"], "secretName": "a"}},
        "spec.link.to[0]",
    ),
    "a limit without a rate": (
        {"ros": "zenoh", "link": {"to": ["tls/cloud"], "secretName": "a", "limits": ["/camera"]}},
        "spec.link.limits[0]",
    ),
    "a link with a rule of parameters": (
        {
            "ros": "zenoh",
            "link": {"to": ["tls/cloud"], "secretName": "a", "policy": ["deny get-param /a"]},
        },
        "spec.link.policy[0]",
    ),
    "no domain": ({"ros": 2, "domain": 233}, "domain"),
    "no peer": ({"ros": 2, "peers": ["a b"]}, "peers[0]"),
    "few ports for ROS 2": ({"ros": 2, "ports": 4, "multicast": True}, "too low for ROS 2"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_spec_is_refused(case: str, net: Namespace) -> None:
    spec, words = BAD[case]
    with pytest.raises(api.Refused) as refused:
        rosproxy(net.name, **spec)
    assert refused.value.status == 422
    assert words in refused.value.text


@pytest.mark.parametrize("name", ["x" * 47, "true"])
def test_bad_name_is_refused(name: str, net: Namespace) -> None:
    with pytest.raises(api.Refused) as refused:
        api.create(rosproxy_body(net.name, name, master=GOOD))
    assert "metadata.name" in refused.value.text


def test_rules_of_a_policy_are_taken(net: Namespace) -> None:
    rules = [
        {**RULE, "names": ["/a", "*/b", "?c"], "nodes": ["/driver", "*"]},
        {"action": "Allow", "kind": "Slave", "names": ["getPid"], "nodes": []},
        {**RULE, "kind": "GetParam", "names": ["/a"] * 31, "nodes": ["/b"] * 15},
    ]
    policy = rosproxy(net.name, master=GOOD, policy={"rules": rules}).body["spec"]["policy"]
    assert policy == {"slaveControl": "Any", "mode": "Enforce", "rules": rules}


@pytest.mark.parametrize(
    "spec",
    [{"ros": 2}, {"ros": "2", "domain": 0, "peers": ["robot", "192.0.2.9:11400"]},
     {"ros": "1,2", "master": GOOD, "multicast": True}, {"ros": 1, "master": GOOD},
     {"ros": "zenoh"},
     {"ros": "zenoh", "listen": {"type": "NodePort", "nodePort": 31447, "annotations": {"a": "b"}}},
     {"ros": "zenoh", "listen": {"type": "LoadBalancer", "loadBalancerClass": "a.example/b"}},
     {"ros": "zenoh", "link": {"to": ["tls/cloud", "quic/[fd00::7]:7448"], "secretName": "a.b",
                               "limits": ["/camera/*=0.5Hz"],
                               "policy": ["allow publish /a", "deny serve *"]}},
     {"ros": "zenoh", "peers": ["robot:7447", "[fd00::7]"], "podEgress": "Proxy"}],
)  # fmt: skip
def test_versions_of_ros_are_taken(spec: dict[str, Any], net: Namespace) -> None:
    stored = rosproxy(net.name, **spec).body["spec"]
    assert spec.items() <= stored.items()


def test_defaults_are_filled_in(net: Namespace) -> None:
    spec = rosproxy(net.name, master=GOOD).body["spec"]
    assert spec["ports"] == 32
    assert spec["portWindow"] == {"first": 11412, "last": 29999}
    assert spec["advertise"] == "InternalIP"
