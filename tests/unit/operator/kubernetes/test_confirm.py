"""Nothing is deleted that was decided from what is not so any more."""

import copy
from collections.abc import Callable
from typing import Any

import pytest

from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.kubernetes.api.api_client import Api, ApiConflict, ApiUnavailable
from rosproxy_operator.kubernetes.confirm_deletion import StateChanged, confirm
from rosproxy_operator.kubernetes.planner.actions import DeleteHelper, DeleteProxy, DeleteService
from rosproxy_operator.kubernetes.resources.model import Name
from rosproxy_operator.kubernetes.resources.names import LAN_RELAY
from tests.unit.operator.kubernetes.api_server import ApiServer
from tests.unit.operator.kubernetes.builders_api import (
    INJECT,
    NAMESPACE,
    pod_obj,
    proxy_obj,
    rosproxy_obj,
    service_obj,
)
from tests.unit.operator.kubernetes.snapshots import snapshot_of

OF = Name(NAMESPACE, "arm")
PROXY = proxy_obj()["metadata"]["name"]
DELETE = DeleteProxy(OF, Name(NAMESPACE, PROXY), f"uid-{PROXY}", "it is not needed")
SERVICE = DeleteService(OF, Name(NAMESPACE, "rosproxy-arm"), "uid-service", "made anew")
NODE = {
    "metadata": {"name": "node1"},
    "status": {"conditions": [{"type": "Ready", "status": "True"}]},
}


def put_all(server: ApiServer) -> None:
    server.put("rosproxies", rosproxy_obj(), NAMESPACE)
    server.put("nodes", copy.deepcopy(NODE))
    server.put("pods", proxy_obj(), NAMESPACE)
    server.put("pods", pod_obj("talker", {}), NAMESPACE)
    server.put("services", service_obj(), NAMESPACE)


def change(server: ApiServer, kind: str, name: str, namespace: str, **meta: Any) -> None:
    obj = copy.deepcopy(server.get(kind, name, namespace))
    obj["metadata"] |= meta
    server.put(kind, obj, namespace)


def relabel(server: ApiServer) -> None:
    change(server, "pods", "talker", NAMESPACE, labels=INJECT)


def come(server: ApiServer) -> None:
    server.put("pods", pod_obj("late", INJECT), NAMESPACE)


def go(server: ApiServer) -> None:
    server.drop("pods", "talker", NAMESPACE)


def lose_node(server: ApiServer) -> None:
    server.drop("nodes", "node1")


def annotate(server: ApiServer) -> None:
    change(server, "nodes", "node1", "", annotations={"rosproxy.io/advertise-host": "gate"})


def edit(server: ApiServer) -> None:
    change(server, "rosproxies", "arm", NAMESPACE, generation=4)


def remake(server: ApiServer) -> None:
    server.put("rosproxies", {**rosproxy_obj(), "metadata": {
        "name": "arm", "namespace": NAMESPACE, "uid": "another", "generation": 1,
    }}, NAMESPACE)  # fmt: skip


def remove(server: ApiServer) -> None:
    server.drop("rosproxies", "arm", NAMESPACE)


async def test_what_is_so_is_confirmed_in_its_version(server: ApiServer, api: Api) -> None:
    put_all(server)
    version = await in_thread(confirm, api, DELETE, snapshot_of(server))
    assert version == server.get("pods", PROXY, NAMESPACE)["metadata"]["resourceVersion"]
    assert await in_thread(confirm, api, SERVICE, snapshot_of(server)) == ""
    server.put("pods", {**server.get("pods", PROXY, NAMESPACE)}, NAMESPACE)
    with pytest.raises(ApiConflict):
        await in_thread(api.delete, "pods", DELETE.id, DELETE.uid, version)


async def test_what_does_not_matter_changes_nothing(server: ApiServer, api: Api) -> None:
    put_all(server)
    seen = snapshot_of(server)
    server.put("pods", pod_obj("far", INJECT, nodeName="node2"), NAMESPACE)
    elsewhere = pod_obj("elsewhere", INJECT)
    elsewhere["metadata"]["namespace"] = "other"
    server.put("pods", elsewhere, "other")
    status = {"status": {"nodes": 1}}
    server.put("rosproxies", {**server.get("rosproxies", "arm", NAMESPACE), **status}, NAMESPACE)
    assert await in_thread(confirm, api, DELETE, seen)


@pytest.mark.parametrize("happen", [relabel, come, go, lose_node, annotate, edit, remake, remove])
async def test_what_is_not_so_any_more(
    server: ApiServer, api: Api, happen: Callable[[ApiServer], None]
) -> None:
    put_all(server)
    seen = snapshot_of(server)
    happen(server)
    with pytest.raises(StateChanged):
        await in_thread(confirm, api, DELETE, seen)
    lan_relay = DeleteHelper(OF, DELETE.id, DELETE.uid, "no longer needed", LAN_RELAY)
    with pytest.raises(StateChanged):
        await in_thread(confirm, api, lan_relay, seen)


@pytest.mark.parametrize("happen", [edit, remake, remove])
async def test_a_service_is_its_rosproxys(
    server: ApiServer, api: Api, happen: Callable[[ApiServer], None]
) -> None:
    put_all(server)
    seen = snapshot_of(server)
    happen(server)
    with pytest.raises(StateChanged, match="RosProxy robots/arm"):
        await in_thread(confirm, api, SERVICE, seen)


@pytest.mark.parametrize("happen", [relabel, come, go, lose_node])
async def test_of_a_rosproxy_that_is_gone_nothing_else_matters(
    server: ApiServer, api: Api, happen: Callable[[ApiServer], None]
) -> None:
    """The garbage collector ends the pods. Waiting for a stable state would leave the nodes
    registered.
    """
    put_all(server)
    remove(server)
    seen = snapshot_of(server)
    happen(server)
    change(server, "pods", PROXY, NAMESPACE, deletionTimestamp="2026-01-01T00:00:00Z")
    assert await in_thread(confirm, api, DELETE, seen) == ""


async def test_an_action_on_an_unseen_object_is_stale(server: ApiServer, api: Api) -> None:
    put_all(server)
    seen = snapshot_of(server)
    other = DeleteProxy(OF, DELETE.id, "another", "it is not needed")
    with pytest.raises(StateChanged):
        await in_thread(confirm, api, other, seen)


async def test_an_api_server_that_does_not_answer_confirms_nothing(
    server: ApiServer, api: Api
) -> None:
    put_all(server)
    seen = snapshot_of(server)
    server.refuse("GET", "pods", 503, "starting")
    with pytest.raises(ApiUnavailable):
        await in_thread(confirm, api, DELETE, seen)
