"""The cluster's API server, spoken to directly: the tests ask far too often for kubectl."""

import json
import time
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any
from urllib.parse import urlencode

import urllib3

from tests.kubernetes.cluster.certificates import certificate_file, key_file
from tests.kubernetes.cluster.layout import API_SERVER

Json = dict[str, Any]
GROUPS = {
    "rosproxies": "apis/rosproxy.io/v1alpha1",
    "deployments": "apis/apps/v1",
    "poddisruptionbudgets": "apis/policy/v1",
    "leases": "apis/coordination.k8s.io/v1",
    "endpointslices": "apis/discovery.k8s.io/v1",
    "networkpolicies": "apis/networking.k8s.io/v1",
    "customresourcedefinitions": "apis/apiextensions.k8s.io/v1",
    "mutatingwebhookconfigurations": "apis/admissionregistration.k8s.io/v1",
    "clusterroles": "apis/rbac.authorization.k8s.io/v1",
    "clusterrolebindings": "apis/rbac.authorization.k8s.io/v1",
    "roles": "apis/rbac.authorization.k8s.io/v1",
    "rolebindings": "apis/rbac.authorization.k8s.io/v1",
}
"""Paths of resources outside of the core group."""
PLURALS = {
    "Pod": "pods", "Service": "services", "RosProxy": "rosproxies", "Namespace": "namespaces",
    "Deployment": "deployments", "ResourceQuota": "resourcequotas", "LimitRange": "limitranges",
    "Endpoints": "endpoints", "Secret": "secrets",
}  # fmt: skip


class Refused(AssertionError):
    """The API server refused a call. ``status`` is the HTTP status, ``text`` the message."""

    def __init__(self, status: int, text: str, warnings: str) -> None:
        super().__init__(f"{status}: {text}")
        self.status = status
        self.text = text
        self.warnings = warnings


def path(resource: str, namespace: str = "", name: str = "", rest: str = "") -> str:
    """The path of objects of a resource (plural, lower case)."""
    segments = [GROUPS.get(resource, "api/v1")]
    segments += ["namespaces", namespace] if namespace else []
    segments += [segment for segment in (resource, name, rest) if segment]
    return "/" + "/".join(segments)


def get(resource: str, namespace: str = "", name: str = "") -> Json:
    """An object; empty if there is none of that name."""
    try:
        return json_call("GET", path(resource, namespace, name))
    except Refused as refused:
        if refused.status == 404:
            return {}
        raise


def objects(resource: str, namespace: str = "", selector: str = "") -> list[Json]:
    """All objects of a resource, everywhere or in a namespace, of a label selector."""
    query = {"labelSelector": selector} if selector else {}
    try:
        items: list[Json] = json_call("GET", path(resource, namespace), query=query)["items"]
    except Refused as refused:
        if refused.status == 404:
            return []
        raise
    return items


def create(body: Json) -> Json:
    """Create an object at the path of its kind and namespace."""
    url_path = path(PLURALS[body["kind"]], body["metadata"].get("namespace", ""))
    return json_call("POST", url_path, body)


def patch(resource: str, namespace: str, name: str, change: Json) -> Json:
    """Change an object by a JSON merge patch."""
    return json_call(
        "PATCH", path(resource, namespace, name), change, kind="application/merge-patch+json"
    )


def delete(resource: str, namespace: str, name: str, *, grace: int | None = None) -> None:
    """Delete an object if it exists. ``grace`` is in seconds."""
    query = {} if grace is None else {"gracePeriodSeconds": str(grace)}
    try:
        json_call("DELETE", path(resource, namespace, name), query=query)
    except Refused as refused:
        if refused.status != 404:
            raise


def logs(namespace: str, pod: str, *, previous: bool = False) -> str:
    """The output of a pod's container; empty if not available."""
    query = {"previous": "true"} if previous else {}
    try:
        return call("GET", path("pods", namespace, pod, "log"), query=query)[0]
    except Refused:
        return ""


def dry_run(body: Json) -> tuple[Json, str]:
    """The object that the API server would create, and the warnings."""
    url_path = path(PLURALS[body["kind"]], body["metadata"].get("namespace", ""))
    text, warnings = call("POST", url_path, body, query={"dryRun": "All"})
    created: Json = json.loads(text)
    return created, warnings


def watch(
    resource: str, namespace: str, selector: str, version: str, seconds: int
) -> Iterator[Json]:
    """The events of objects since a version, for some seconds. Without a version, first all
    objects. Raises urllib3.exceptions.HTTPError.
    """
    query = {"watch": "1", "labelSelector": selector, "timeoutSeconds": str(seconds)}
    query |= {"resourceVersion": version} if version else {}
    url = API_SERVER + path(resource, namespace) + _query(query)
    answer = _pool().request("GET", url, preload_content=False)
    if answer.status != 200:  # the version is too old
        yield {"type": "ERROR"}
    rest = b""
    try:
        for piece in answer.stream() if answer.status == 200 else ():
            *lines, rest = (rest + piece).split(b"\n")
            yield from map(json.loads, lines)
    finally:
        answer.release_conn()


def json_call(method: str, url_path: str, body: Json | None = None, **more: Any) -> Json:
    answer: Json = json.loads(call(method, url_path, body, **more)[0])
    return answer


def call(
    method: str, url_path: str, body: Json | None = None, *,
    query: Mapping[str, str] | None = None, kind: str = "application/json",
) -> tuple[str, str]:  # fmt: skip
    """Make a call; return the body and the warnings of the answer.

    During a restart of the API server, calls are repeated for half a minute.
    """
    end = time.monotonic() + 30
    while True:
        try:
            answer = _pool().request(
                method, API_SERVER + url_path + _query(query or {}),
                body=None if body is None else json.dumps(body), headers={"Content-Type": kind},
            )  # fmt: skip
        except urllib3.exceptions.HTTPError:
            if time.monotonic() > end:
                raise
            time.sleep(0.2)
            continue
        text = answer.data.decode(errors="replace")
        warnings = answer.headers.get("Warning", "")
        if answer.status >= 400:
            raise Refused(answer.status, _message(text), warnings)
        return text, warnings


def _message(text: str) -> str:
    try:
        return str(json.loads(text).get("message", text))
    except (ValueError, AttributeError):
        return text


def _query(query: Mapping[str, str]) -> str:
    return f"?{urlencode(query)}" if query else ""


@cache
def _pool() -> urllib3.PoolManager:
    return urllib3.PoolManager(
        cert_file=str(certificate_file("admin")), key_file=str(key_file("admin")),
        ca_certs=str(certificate_file("ca")), maxsize=8, retries=False, timeout=30,
    )  # fmt: skip
