"""A running proxy survives the upgrade of its operator: recorded fingerprints and variables.

The operator recreates a proxy with another fingerprint, which cuts the nodes' connections. So a
change of ``recorded_proxies.json`` needs a line in CHANGELOG.md. To record:

    python -m tests.unit.operator.test_recorded_proxies
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest

from rosproxy.shared.policy.rules import parse_rules
from rosproxy.shared.ports import PortRange
from rosproxy.shared.setting_kinds import TopicLimit
from rosproxy_operator.common.policy import administrators_policy
from rosproxy_operator.common.proxy_bounds import ProxyBounds
from rosproxy_operator.docker.planner.actions import Create, CreateSandbox
from rosproxy_operator.docker.planner.model import Attachment, Container, HostState
from rosproxy_operator.docker.planner.specs import container_config
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.kubernetes.planner.actions import CreateProxy
from rosproxy_operator.kubernetes.planner.manifests import fingerprint_of
from rosproxy_operator.kubernetes.resources.spec import rosproxy
from rosproxy_operator.kubernetes.settings import ClusterSettings
from tests.unit.operator.docker import builders as docker
from tests.unit.operator.kubernetes import objects as kubernetes

RECORD = Path(__file__).with_name("recorded_proxies.json")
POLICY = administrators_policy([parse_rules("deny publish /camera/*; deny call *")], "audit")
BOUNDS = ProxyBounds(16, 8, 100, 50)
ROS1 = {"rosproxy.master-uri": "http://robot:11312"}
ROS2 = {"rosproxy.ros": "2", "rosproxy.domain": "7"}
ZENOH = {"rosproxy.ros": "2", "rosproxy.rmw": "zenoh"}
RICH = {
    "rosproxy.ports": "40",
    "rosproxy.data-plane": "kernel",
    "rosproxy.direction": "both",
    "rosproxy.udp": "true",
    "rosproxy.slave-control": "master",
    "rosproxy.policy": "deny publish /secret; allow call /a by /b",
}
PEERS = {"rosproxy.peers": "robot, 192.0.2.7 other-host:11412"}
DOCKER: dict[str, tuple[dict[str, Any], list[dict[str, str]]]] = {
    "plain": ({}, [ROS1]),
    "rich": ({"allow_data_plane": ("kernel",)}, [{**ROS1, **RICH}]),
    "merged": (
        {"max_ports": 48, "proxy_bounds": BOUNDS, "policy": POLICY},
        [
            {**ROS1, "rosproxy.ports": "64", "rosproxy.data-plane": "copy"},
            {**ROS1, "rosproxy.ports": "8", "rosproxy.data-plane": "splice"},
            {**ROS1, "rosproxy.slave-control": "master", "rosproxy.udp": "true"},
            {**ROS1, "rosproxy.direction": "both", "rosproxy.policy": "deny serve *"},
        ],
    ),
    "refused": (
        {"slave_control": "master", "allow_peer": ("robot:*",)},
        [
            {**ROS1, "rosproxy.data-plane": "kernel", "rosproxy.slave-control": "any"},
            {**ROS2, **PEERS},
        ],
    ),
    "options": (
        {
            "ports": 12,
            "data_plane": "splice",
            "direction": "both",
            "udp": True,
            "slave_control": "master",
            "ros2_peer": ("arm",),
            "proxy_memory": 0,
        },
        [{**ROS1, "rosproxy.ros": "1,2"}, {**ROS1, "rosproxy.direction": "out"}],
    ),
    "ros2": ({"allow_data_plane": ("kernel",)}, [{**RICH, **ROS2, **PEERS}]),
    "zenoh": ({"policy": POLICY}, [{**ZENOH, "rosproxy.peers": "robot"}]),
    "zenoh link": (
        {
            "zenoh_link": ("tls/home:7447",),
            "allow_link": ("tls/cloud:*",),
            "zenoh_link_certificates": "/etc/rosproxy/link",
            "zenoh_limit": (TopicLimit("/camera/image", 2.0),),
            "zenoh_link_policy": (parse_rules("deny publish /secret"),),
        },
        [{**ZENOH, "rosproxy.zenoh-link": "tls/cloud"}],
    ),
    "ros2 merged": (
        {"ros2_peer": ("arm",), "proxy_bounds": BOUNDS, "policy": POLICY},
        [{**ROS2, **PEERS}, {**ROS2, "rosproxy.peers": "robot cam", "rosproxy.data-plane": "auto"}],
    ),
}
"""By name: the options of the operator, and the labels of the containers."""
MASTER = {"uri": "http://robot:11311"}
RULES = [
    {"action": "Deny", "kind": "Publish", "names": ["/secret"], "nodes": ["/a", "/b"]},
    {"action": "Allow", "kind": "Slave", "names": ["shutdown"]},
]
KUBERNETES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "plain": ({}, {"master": MASTER}),
    "rich": (
        {"policy": POLICY, "proxy_bounds": BOUNDS},
        {
            "master": {**MASTER, "address": "192.0.2.9"},
            "ports": 8,
            "cleanupAfterSeconds": 7.5,
            "dataPlane": "Kernel",
            "direction": "Both",
            "udp": True,
            "policy": {"slaveControl": "Master", "mode": "Audit", "rules": RULES},
            "hostAliases": [{"ip": "192.0.2.9", "hostnames": ["robot"]}],
            "image": "rosproxy:2",
        },
    ),
    "master inside": (
        {},
        {"master": {"service": {"name": "roscore"}, "publish": 11500}, "dataPlane": "Copy"},
    ),
    "narrowed": (
        {"bounds": msgspec.structs.replace(kubernetes.BOUNDS, slave_control="master")},
        {"master": MASTER, "cleanupAfterSeconds": 0, "dataPlane": "Auto"},
    ),
    "ros2": (
        {},
        {"ros": 2, "domain": 7, "peers": ["Robot", "192.0.2.9:11400"], "multicast": True},
    ),
    "both": (
        {"proxy_bounds": BOUNDS},
        {
            "ros": "1,2",
            "master": MASTER,
            "dataPlane": "Splice",
            "direction": "Both",
            "udp": True,
            "policy": {"rules": RULES},
        },
    ),
    "zenoh": ({"policy": POLICY}, {"ros": "zenoh", "peers": ["robot"]}),
    "zenoh link": (
        {},
        {
            "ros": "zenoh",
            "link": {
                "to": ["tls/cloud"],
                "secretName": "link",
                "limits": ["/camera/image=2Hz"],
                "policy": ["deny publish /secret"],
            },
        },
    ),
    # The fingerprint has the former range for outgoing connections: `manifests._FORMER_LOCAL_PORTS`
    "high ports": (
        {"ephemeral": PortRange(61000, 65535)},
        {"ros": 2, "portWindow": {"first": 40000, "last": 49999}},
    ),
    # The fingerprint has the TCP hostPort that former operators gave to the LAN relay's port.
    "both with multicast": ({}, {"ros": "1,2", "master": MASTER, "multicast": True}),
}
"""By name: the options of the operator, and the spec of the RosProxy."""


def host(labels: list[dict[str, str]]) -> HostState:
    """A host with a container for each set of labels."""
    containers = [
        Container(
            f"id-{number}",
            f"node-{number}",
            "running",
            {"rosproxy.enable": "true", **own},
            "app",
            (Attachment("app", f"172.18.0.{number + 10}"),),
            master_uri="http://rosproxy:11312",
        )
        for number, own in enumerate(labels)
    ]
    return docker.observed(*containers)


def docker_proxies(name: str) -> Iterator[tuple[str, Any]]:
    """Sandbox and proxy that the Docker operator makes: fingerprints, and the proxy's variables."""
    options, labels = DOCKER[name]
    settings: PlanSettings = replace(docker.SETTINGS, **options)
    plan = docker.planned(host(labels), settings, DockerMemory(), 0.0)
    for action in plan.actions + tuple(a for group in plan.deferred for a in group.actions):
        if isinstance(action, CreateSandbox):
            yield action.name, {"fingerprint": action.fingerprint}
        if isinstance(action, Create):
            body = container_config(action, settings, docker.SECRET, "192.0.2.9")
            yield action.name, {"fingerprint": action.fingerprint, "variables": body["Env"]}


def cluster_proxies(name: str) -> Iterator[tuple[str, Any]]:
    """Each proxy's pod that the Kubernetes operator makes: fingerprint and variables."""
    options, spec = KUBERNETES[name]
    settings: ClusterSettings = msgspec.structs.replace(kubernetes.SETTINGS, **options)
    meta = {"name": "robot", "namespace": "ros", "uid": "uid-robot", "generation": 1}
    of = rosproxy({"metadata": meta, "spec": spec})
    service = of.spec.master.service
    masters = {service: ("10.96.0.9", "")} if service else {}
    seen = msgspec.structs.replace(kubernetes.scene(of=of), key=b"k" * 32, masters=masters)
    for action in kubernetes.look(seen, settings=settings).actions:
        if isinstance(action, CreateProxy):
            (container,) = action.body["spec"]["containers"]
            variables = [f"{v['name']}={v['value']}" for v in container["env"]]
            fingerprint = fingerprint_of(action.body)
            yield (
                action.body["metadata"]["name"],
                {
                    "fingerprint": fingerprint,
                    "variables": variables,
                },
            )


def recorded(engine: str) -> Mapping[str, Any]:
    """The record of an engine, by the name of the case."""
    return dict(json.loads(RECORD.read_text())[engine])


@pytest.mark.parametrize("name", DOCKER)
def test_a_container_is_made_as_before(name: str) -> None:
    assert dict(docker_proxies(name)) == recorded("docker")[name]


@pytest.mark.parametrize("name", KUBERNETES)
def test_a_pod_is_made_as_before(name: str) -> None:
    assert dict(cluster_proxies(name)) == recorded("kubernetes")[name]


if __name__ == "__main__":
    made = {
        "docker": {name: dict(docker_proxies(name)) for name in DOCKER},
        "kubernetes": {name: dict(cluster_proxies(name)) for name in KUBERNETES},
    }
    RECORD.write_text(f"{json.dumps(made, indent=2)}\n")
