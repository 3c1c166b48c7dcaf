"""The API server is asked by the real client, over HTTP; errors say what to do."""

import json
from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.kubernetes.api.api_client import (
    SOON,
    Api,
    ApiConflict,
    ApiError,
    ApiInvalid,
    ApiNotFound,
    ApiUnavailable,
    refusal,
)
from rosproxy_operator.kubernetes.api.rbac import missing_rule
from rosproxy_operator.kubernetes.resources.model import Name
from rosproxy_operator.kubernetes.resources.names import own_labels
from tests.unit.operator.kubernetes.api_server import ApiServer, listening, write_kubeconfig

FORBIDDEN = (
    'pods is forbidden: User "system:serviceaccount:rosproxy:rosproxy" cannot list resource '
    '"pods" in API group "" at the cluster scope'
)


def pod(name: str, **labels: str) -> dict[str, object]:
    return {"metadata": {"name": name, "labels": labels}, "spec": {"nodeName": "node1"}}


def names(listed: Iterable[dict[str, Any]]) -> set[str]:
    return {o["metadata"]["name"] for o in listed}


async def test_lists_with_selectors(server: ApiServer, api: Api) -> None:
    server.put("pods", pod("a", app="x"))
    server.put("pods", pod("other", app="x"), "elsewhere")
    server.put("pods", {"metadata": {"name": "mine", "labels": own_labels("arm")}})
    assert names(await in_thread(api.list_fresh, "pods", "", "spec.nodeName=node1")) == {
        "a",
        "other",
    }
    assert names(await in_thread(api.list_fresh, "pods", "ns", "metadata.name=a")) == {"a"}
    assert names(await in_thread(api.own_pods)) == {"mine"}
    assert not any("resourceVersion" in query for query in server.asked("GET", "pods"))


async def test_a_list_comes_in_pages(
    server: ApiServer, api: Api, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rosproxy_operator.kubernetes.api.api_client.MOST_PAGE_ITEMS", 2)
    for name in "abc":
        server.put("pods", pod(name))
    first = await in_thread(api.page, "pods", "")
    last = await in_thread(api.page, "pods", "", first.continue_token)
    assert (names(first.items), names(last.items), last.continue_token) == ({"a", "b"}, {"c"}, "")


async def test_a_throttled_request_is_repeated_after_the_given_time(
    server: ApiServer, api: Api, monkeypatch: pytest.MonkeyPatch
) -> None:
    """API Priority and Fairness answers with 429. A call with a short time limit fails at once."""
    slept: list[float] = []
    monkeypatch.setattr("rosproxy_operator.kubernetes.api.api_client.time.sleep", slept.append)
    server.refuse("GET", "nodes", 429, "too many requests")
    server.retry_after = "7"
    with pytest.raises(ApiUnavailable, match="too many requests"):
        await in_thread(api.page, "nodes", "")
    assert slept == [7.0] * 3
    assert len(server.asked("GET", "nodes")) == 4
    with pytest.raises(ApiUnavailable):
        await in_thread(api.get, "nodes", Name("", "node1"), SOON)
    assert slept == [7.0] * 3
    server.retry_after = "999999"
    with pytest.raises(ApiUnavailable):
        await in_thread(api.page, "nodes", "")
    assert max(slept) == 10.0


async def test_rosproxies_are_listed_from_the_store(server: ApiServer, api: Api) -> None:
    await in_thread(api.rosproxies)
    assert server.asked("GET", "rosproxies") == [{}]


async def test_only_the_given_namespaces_are_listed(server: ApiServer) -> None:
    api = Api(["one", "two"])
    server.put("rosproxies", {"metadata": {"name": "arm"}}, "two")
    server.put("rosproxies", {"metadata": {"name": "leg"}}, "three")
    rosproxies = await in_thread(api.rosproxies)
    assert [rosproxy["metadata"]["name"] for rosproxy in rosproxies] == ["arm"]
    api.close()


async def test_deletes_only_what_has_the_uid(server: ApiServer, api: Api) -> None:
    server.put("pods", pod("a"))
    with pytest.raises(ApiError) as caught:
        await in_thread(api.delete, "pods", Name("ns", "a"), "another")
    assert type(caught.value) is ApiConflict
    uid = server.get("pods", "a")["metadata"]["uid"]
    await in_thread(api.delete, "pods", Name("ns", "a"), uid)
    assert not server.all("pods")


async def test_fields_that_the_client_does_not_know_get_through(
    server: ApiServer, api: Api
) -> None:
    body = {"metadata": {"namespace": "ns", "name": "a"}, "spec": {"newerThanUs": {"x": [1]}}}
    await in_thread(api.create, "pods", body)
    assert server.get("pods", "a")["spec"] == {"newerThanUs": {"x": [1]}}


async def test_a_patch_with_a_failed_test_is_a_conflict(server: ApiServer, api: Api) -> None:
    server.put("pods", pod("a"))
    operations = [{"op": "test", "path": "/metadata/uid", "value": "another"}]
    with pytest.raises(ApiError) as caught:
        await in_thread(api.patch, "pods", Name("ns", "a"), operations)
    assert type(caught.value) is ApiConflict


async def test_the_token_is_sent(server: ApiServer, api: Api) -> None:
    assert api.server == server.url
    configuration = api._client.configuration
    assert configuration.get_api_key_with_prefix("BearerToken") == "Bearer secret"


async def test_an_api_server_that_is_away_and_back(
    tmp_path: Path, server: ApiServer, api: Api
) -> None:
    other = ApiServer()
    async with listening(other):
        port = int(other.url.rpartition(":")[2])
    write_kubeconfig(tmp_path / "config", other.url)
    late = Api()
    with pytest.raises(ApiError, match=f"API server at {other.url} can't be reached") as caught:
        await in_thread(late.page, "nodes", "")
    assert type(caught.value) is ApiUnavailable
    async with listening(other, port):
        assert [*(await in_thread(late.page, "nodes", "")).items] == []
        late.close()


async def test_what_is_no_api_server_is_away(server: ApiServer, api: Api) -> None:
    server.refuse("GET", "nodes", 200, "hello")
    with pytest.raises(ApiError, match="is not an API server") as caught:
        await in_thread(api.page, "nodes", "")
    assert type(caught.value) is ApiUnavailable


@pytest.mark.parametrize("text", [b"", b"<html>", b"[]", b"\xff", b'{"items": ["\xff"]}'])
async def test_what_does_not_answer_in_json_is_away(
    api: Api, monkeypatch: pytest.MonkeyPatch, text: bytes
) -> None:
    response = SimpleNamespace(read=lambda _: text)
    answer = SimpleNamespace(status=200, reason="OK", response=response, getheader=lambda *_: "")
    monkeypatch.setattr(api._client, "call_api", lambda *_, **__: answer)

    def listed() -> None:
        list(api.page("nodes", "").items)

    with pytest.raises(ApiUnavailable, match="/api/v1/nodes is not an API server"):
        await in_thread(listed)


async def test_a_page_of_large_objects_is_asked_for_in_parts(
    server: ApiServer, api: Api, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reading 500 pods of a megabyte each at once would end the operator, at each start."""
    monkeypatch.setattr("rosproxy_operator.kubernetes.api.api_client.MOST_PAGE_BYTES", 30_000)
    large = {f"a{number}": "x" * 60 for number in range(100)}
    for number in range(9):
        server.put("pods", pod(f"p{number}", **large))
    server.put("pods", pod("q", **{f"a{number}": "x" * 60 for number in range(1000)}))

    def listed() -> set[str]:
        found = set[str]()
        token = ""
        while True:
            page = api.page("pods", "", token)
            found |= names(page.items)
            token = page.continue_token
            if not token:
                return found

    assert await in_thread(listed) == {"q", *(f"p{number}" for number in range(9))}
    assert {"500", "62", "7", "1"} == {query["limit"] for query in server.asked("GET", "pods")}

    def each() -> set[str]:
        return names(api.each("pods", "", "spec.nodeName=node1"))

    assert await in_thread(each) == await in_thread(listed)


def test_no_cluster_is_one_line_that_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("KUBERNETES_SERVICE_HOST", raising=False)
    monkeypatch.setattr(
        "kubernetes.config.kube_config.KUBE_CONFIG_DEFAULT_LOCATION", str(tmp_path / "none")
    )
    with pytest.raises(ApiError, match=r"no Kubernetes cluster is configured .* name a kubeconfig"):
        Api()


@pytest.mark.parametrize(
    ("status", "message", "kind", "told"),
    [
        (403, FORBIDDEN, ApiError, 'apiGroups [""], resources ["pods"], verbs ["list"]'),
        (
            403,
            'pods "p" is forbidden: violates PodSecurity "baseline"',
            ApiInvalid,
            "violates",
        ),
        (
            403,
            "unable to create new content in namespace x because it is being terminated",
            ApiNotFound,
            "terminated",
        ),
        (401, "Unauthorized", ApiUnavailable, "does not accept this program's token"),
        (404, 'pods "p" not found', ApiNotFound, 'pods "p" not found'),
        (409, "exists", ApiConflict, "exists"),
        (422, "spec.clusterIP: Invalid value", ApiInvalid, "spec.clusterIP"),
        (429, "storage is (re)initializing", ApiUnavailable, "HTTP 429"),
        (503, "etcd", ApiUnavailable, "HTTP 503: etcd"),
        (418, "tea", ApiError, "tea"),
    ],
)
def test_refusals(status: int, message: str, kind: type[ApiError], told: str) -> None:
    body = json.dumps({"kind": "Status", "message": message})
    error = refusal(status, "reason", body.encode())
    assert type(error) is kind
    assert told in str(error)
    assert "\n" not in str(error)


@pytest.mark.parametrize("body", [b"", b"<html>\xff", b"[]", b'{"message": 3}'])
def test_a_refusal_by_anything_else(body: bytes) -> None:
    assert str(refusal(500, "Internal Server Error", body))


def test_the_missing_rule_names_its_namespace() -> None:
    text = 'User "x" cannot get resource "secrets" in API group "" in the namespace "rosproxy"'
    assert missing_rule(text).startswith("the operator's role lacks a rule in the namespace ros")
    assert missing_rule("violates PodSecurity") == ""
