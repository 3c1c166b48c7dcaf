"""One look at the cluster, from an API server on loopback."""

from typing import Any

import pytest

from rosproxy_operator.kubernetes.api import Api, ApiError, ApiGone, ApiInvalid
from rosproxy_operator.kubernetes.resources.model import Name, Stuck
from rosproxy_operator.kubernetes.snapshot import SnapshotReader, read_master
from rosproxy_operator.kubernetes.token_key import TokenKey
from tests.unit.operator.kubernetes.api_server import ApiServer
from tests.unit.operator.kubernetes.builders_api import (
    INJECT,
    NAMESPACE,
    pod_obj,
    proxy_obj,
    rosproxy_obj,
)

SERVICE = {"service": {"name": "roscore", "namespace": "ros", "port": 11311}}
SANDBOX = 'Failed to create pod sandbox: plugin "portmap" (id "{}"): cannot open hostport 11400'


def reader(api: Api) -> SnapshotReader:
    return SnapshotReader(api, TokenKey(api, None))


def node(name: str) -> dict[str, Any]:
    return {
        "metadata": {"name": name},
        "status": {"conditions": [{"type": "Ready", "status": "True"}]},
    }


def put_all(server: ApiServer) -> None:
    server.put("rosproxies", rosproxy_obj(), NAMESPACE)
    for name in ("node1", "node2", "node3"):
        server.put("nodes", node(name))
    server.put("pods", pod_obj("talker", INJECT), NAMESPACE)
    server.put("pods", pod_obj("stranger", {}), NAMESPACE)
    elsewhere = pod_obj("far", {}, nodeName="node3")
    server.put("pods", elsewhere, NAMESPACE)
    server.put("pods", proxy_obj(node="node2"), NAMESPACE)


async def test_a_look(server: ApiServer, api: Api) -> None:
    put_all(server)
    found = await reader(api).read()
    assert [each.id.name for each in found.rosproxies] == ["arm"]
    assert set(found.nodes) == {"node1", "node2", "node3"}
    assert {pod.id.name for pod in found.pods} >= {"talker", "stranger"}
    assert "far" not in {pod.id.name for pod in found.pods}
    assert [proxy.on for proxy in found.proxies] == ["node2"]
    assert found.selected == {"uid-talker"}
    asked = [
        query["fieldSelector"] for query in server.asked("GET", "pods") if "fieldSelector" in query
    ]
    assert sorted(asked) == ["spec.nodeName=node1", "spec.nodeName=node2"]


async def test_rosproxies_come_first(server: ApiServer, api: Api) -> None:
    put_all(server)
    await reader(api).read()
    assert server.requests[0][1].endswith("/rosproxies")


async def test_all_or_nothing(server: ApiServer, api: Api) -> None:
    """A list that is missing would look like pods that are gone."""
    put_all(server)
    server.refuse("GET", "nodes", 500, "etcd")
    with pytest.raises(ApiError):
        await reader(api).read()


async def test_one_bad_rosproxy_does_not_stop_the_others(server: ApiServer, api: Api) -> None:
    put_all(server)
    server.put("rosproxies", rosproxy_obj({"master": {}}, "bad"), NAMESPACE)
    server.put("rosproxies", {"metadata": {"name": "worse"}, "spec": 3}, NAMESPACE)
    found = await reader(api).read()
    assert [each.id.name for each in found.rosproxies] == ["arm"]
    assert {id.name for id in found.unusable} == {"bad", "worse"}


async def test_a_selector_that_the_api_server_refuses_is_that_rosproxys_problem(
    server: ApiServer, api: Api
) -> None:
    put_all(server)
    leg = rosproxy_obj(name="leg")
    leg["metadata"]["namespace"] = "other"
    server.put("rosproxies", leg)
    real = api.pods

    def pods(namespace: str, selector: str) -> list[dict[str, Any]]:
        if namespace == "other":
            raise ApiInvalid("unable to parse requirement")
        return real(namespace, selector)

    api.pods = pods  # type: ignore[method-assign]
    found = await reader(api).read()
    (bad,) = found.unusable.values()
    assert bad.text == "spec.podSelector: unable to parse requirement"
    assert [each.id.name for each in found.rosproxies] == ["arm"]


async def test_a_missing_crd_is_told(server: ApiServer, api: Api) -> None:
    server.refuse("GET", "rosproxies", 404, "the server could not find the requested resource")
    with pytest.raises(ApiError, match="install the CustomResourceDefinition") as caught:
        await reader(api).read()
    assert type(caught.value) is ApiGone


async def test_what_only_an_event_tells(server: ApiServer, api: Api) -> None:
    put_all(server)
    server.drop("pods", "rosproxy-arm-node2-" + _digest(server), NAMESPACE)
    starting = proxy_obj(status={"phase": "Pending"})
    server.put("pods", starting, NAMESPACE)
    for number, stamp in ((1, "2026-01-01T00:00:01Z"), (2, "2026-01-01T00:00:02Z")):
        event = {
            "metadata": {"name": f"e{number}"},
            "involvedObject": {"uid": starting["metadata"]["uid"]},
            "reason": "FailedCreatePodSandBox",
            "message": SANDBOX.format(f"{number}" * 64),
            "lastTimestamp": stamp,
        }
        server.put("events", event, NAMESPACE)
    found = await reader(api).read()
    (proxy,) = found.proxies
    assert proxy.stuck is Stuck.PORTS
    assert proxy.message == SANDBOX.format("…")


def _digest(server: ApiServer) -> str:
    names = [pod["metadata"]["name"] for pod in server.all("pods")]
    return next(name for name in names if name.startswith("rosproxy-arm")).rpartition("-")[2]


async def test_the_service_of_a_master(server: ApiServer, api: Api) -> None:
    obj = rosproxy_obj()
    obj["spec"] = {"master": SERVICE}
    server.put("rosproxies", obj, NAMESPACE)
    id = Name("ros", "roscore")
    assert (await reader(api).read()).masters == {
        id: ("", "there is no Service roscore in the namespace ros: create it")
    }
    ports = [{"port": 11311}]
    server.put(
        "services",
        {"metadata": {"name": "roscore"}, "spec": {"clusterIP": "10.96.1.1", "ports": ports}},
        "ros",
    )
    found = await reader(api).read()
    assert found.masters == {id: ("10.96.1.1", "")}
    assert found.consents == {id: frozenset()}


async def test_who_may_name_a_service(server: ApiServer, api: Api) -> None:
    server.put("rosproxies", rosproxy_obj({"master": SERVICE}), NAMESPACE)
    notes = {"rosproxy.io/allow-from": f"{NAMESPACE}, arms ,No Name,"}
    server.put("services", {"metadata": {"name": "roscore", "annotations": notes}}, "ros")
    found = await reader(api).read()
    assert found.consents == {Name("ros", "roscore"): {NAMESPACE, "arms"}}


async def test_a_role_without_the_right_to_policies_stops_nothing(
    server: ApiServer, api: Api
) -> None:
    put_all(server)
    refusal = (
        'networkpolicies.networking.k8s.io is forbidden: User "x" cannot list resource '
        '"networkpolicies" in API group "networking.k8s.io" at the cluster scope'
    )
    server.refuse("GET", "networkpolicies", 403, refusal)
    found = await reader(api).read()
    assert 'resources ["networkpolicies"], verbs ["list"]' in found.no_policies
    assert [each.id.name for each in found.rosproxies] == ["arm"]
    server.refuse("GET", "networkpolicies", 503, "starting")
    with pytest.raises(ApiError):
        await reader(api).read()


@pytest.mark.parametrize(
    ("spec", "told"),
    [
        ({"clusterIP": "None"}, "has no cluster IP (headless)"),
        ({"type": "ExternalName"}, "has no cluster IP (ExternalName)"),
        ({"clusterIP": "10.96.1.1", "ports": [{"port": 80}]}, "has no port 11311 (it has 80)"),
        ({"clusterIP": "10.96.1.1"}, "has no port 11311 (it has none)"),
        ({}, "has no cluster IP"),
    ],
)
def test_a_service_that_is_no_master(spec: dict[str, Any], told: str) -> None:
    address, problem = read_master({"spec": spec}, Name("ros", "roscore"), {11311})
    assert address == ""
    assert told in problem
