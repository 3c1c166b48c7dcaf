"""The API server as far as the operator needs it: a thin layer over the `kubernetes` client.

Its service account may do exactly this; ``watch`` is what kopf does. Those of the second part are
for single objects, by name::

    nodes                   list watch
    pods                    get list watch create delete patch
    services                get list watch create delete
    networkpolicies         list create patch delete
    events                  get list create patch
    rosproxies              list watch
    rosproxies/status       patch

    secrets                                get patch
    mutatingwebhookconfigurations          get patch

Objects go in and out as JSON: the client's models would drop fields that are newer than they are.
"""

import contextlib
import json
import os
import re
from collections.abc import Mapping, Sequence
from typing import Any
from urllib.parse import quote

import msgspec
from kubernetes.client import ApiClient, Configuration
from kubernetes.client.exceptions import ApiException
from kubernetes.config import ConfigException, load_incluster_config, load_kube_config
from urllib3.exceptions import HTTPError

from rosproxy import __version__
from rosproxy_operator.kubernetes.resources.model import Json, Name
from rosproxy_operator.kubernetes.resources.names import GROUP, OWN_SELECTOR, PLURAL, VERSION
from rosproxy_operator.kubernetes.resources.values import part, word

Found = dict[str, Any]
Timeout = tuple[float, float]
WITHIN: Timeout = (3.0, 15.0)
"""Seconds to connect and to wait for an answer."""
SOON: Timeout = (1.0, 2.0)
"""The same while somebody waits for a pod to be admitted."""
WEBHOOKS = "mutatingwebhookconfigurations"
POLICIES = "networkpolicies"
_ROOTS = {
    PLURAL: f"/apis/{GROUP}/{VERSION}",
    WEBHOOKS: "/apis/admissionregistration.k8s.io/v1",
    POLICIES: "/apis/networking.k8s.io/v1",
}
"""Where kinds are found that are not of the core group."""
_CONNECTIONS = 16


_RBAC = re.compile(
    r'cannot (?P<verb>\w+) resource "(?P<resource>[^"]*)" in API group "(?P<group>[^"]*)"'
    r'(?: in the namespace "(?P<namespace>[^"]*)")?'
)
_TERMINATING = "because it is being terminated"
"""What the admission plug-in NamespaceLifecycle says of a namespace that is being deleted.

Nothing can be created there, and nothing is to be.
"""
_TEST_FAILED = "the server rejected our request due to an error in our request"
"""All that the API server says when a ``test`` of a JSON patch fails."""
_LONGEST = 500


class ApiError(Exception):
    """The API server did not do what it was asked; the message is one line.

    Its subclasses say why, as far as that makes a difference.
    """


class ApiAway(ApiError):
    """It can't be reached, or is not ready to answer."""


class ApiGone(ApiError):
    """The object is not there, or the namespace is about to go that it is to be in."""


class ApiConflict(ApiError):
    """The name is taken, or the object is another one by now."""


class ApiInvalid(ApiError):
    """The object is not one that the API server takes."""


_KINDS: Mapping[int, type[ApiError]] = {
    400: ApiInvalid,
    401: ApiAway,  # the token has just been replaced, or the server does not know it yet
    404: ApiGone,
    409: ApiConflict,
    422: ApiInvalid,
    429: ApiAway,
}


class Api:
    """The cluster that this process runs in, else the one that KUBECONFIG names.

    Can be used by many threads. Every method raises ApiError. ``namespaces`` are those that are
    looked after; all if there are none.
    """

    def __init__(self, namespaces: Sequence[str] = ()) -> None:
        self._places = tuple(namespaces) or ("",)
        configuration = _configuration()
        self.server = str(configuration.host)
        self._client = ApiClient(configuration)
        self._client.user_agent = f"rosproxy-operator/{__version__}"
        self._versions: dict[str, str] = {}

    def close(self) -> None:
        """Close all connections."""
        self._client.close()  # type: ignore[no-untyped-call]

    def rosproxies(self, namespace: str = "", within: Timeout = WITHIN) -> list[Found]:
        """All RosProxies, or those of a namespace, as they are at this moment."""
        places = (namespace,) if namespace else self._places
        lists = [self._ask("GET", _path(PLURAL, place), within=within) for place in places]
        return [found for each in lists for found in self._items(each)]

    def nodes(self) -> list[Found]:
        """All nodes."""
        return self._cached("", "nodes", {})

    def own(self, kind: str) -> list[Found]:
        """The ``pods``, ``services`` or ``networkpolicies`` that the operator has made."""
        query = {"labelSelector": OWN_SELECTOR}
        return [found for place in self._places for found in self._cached(place, kind, query)]

    def pods(self, namespace: str, selector: str) -> list[Found]:
        """The pods of a namespace that a label selector fits."""
        return self._cached(namespace, "pods", {"labelSelector": selector})

    def pods_on(self, node: str) -> list[Found]:
        """All pods on a node, whatever their namespace: all of them may hold ports there."""
        return self._cached("", "pods", {"fieldSelector": f"spec.nodeName={node}"})

    def events_of(self, pod: Name, uid: str, reason: str) -> list[Found]:
        """The Events with a reason about a pod."""
        query = {"fieldSelector": f"involvedObject.uid={uid},reason={reason}"}
        return self._items(self._ask("GET", _path("events", pod.namespace), query))

    def get(self, kind: str, id: Name, within: Timeout = WITHIN) -> Found:
        """One object, for example of the kind ``services``."""
        return self._ask("GET", _path(kind, id.namespace, id.name), within=within)

    def create(self, kind: str, body: Json) -> None:
        """Create an object in the namespace that it names."""
        self._ask("POST", _path(kind, body["metadata"]["namespace"]), body=body)

    def delete(self, kind: str, id: Name, uid: str) -> None:
        """Delete an object if it still has this uid."""
        options = {"apiVersion": "v1", "kind": "DeleteOptions", "preconditions": {"uid": uid}}
        self._ask("DELETE", _path(kind, id.namespace, id.name), body=options)

    def patch(self, kind: str, id: Name, operations: list[Json]) -> None:
        """Change an object, or a part of it as ``rosproxies/status``, by a JSON patch."""
        self._ask("PATCH", _path(kind, id.namespace, id.name), body=operations)

    def _cached(self, namespace: str, kind: str, query: Mapping[str, str]) -> list[Found]:
        """List from what the API server has in memory, which costs etcd nothing.

        It may lag behind a little, but never behind a list before: another API server, which lags
        more, would otherwise make pods seem gone that are not.
        """
        path = _path(kind, namespace)
        version = {"resourceVersion": self._versions.get(kind, "0")}
        if kind in self._versions:
            version["resourceVersionMatch"] = "NotOlderThan"
        try:
            found = self._ask("GET", path, {**query, **version})
        except ApiError as error:
            if "resource version" not in str(error).lower():
                raise
            # The store was set back, or no API server has caught up: ask the store itself.
            self._versions.pop(kind, None)
            found = self._ask("GET", path, query)
        items = self._items(found)
        newest = word(part(found, "metadata"), "resourceVersion")
        # Lists of a kind are asked for side by side.
        if newest.isdecimal() and int(newest) > int(self._versions.get(kind, "0")):
            self._versions[kind] = newest
        return items

    def fill_secret(self, name: Name, there: Json, entries: Mapping[str, str]) -> None:
        """Write entries (in base64) into a Secret, if it is as it was when it was read.

        Raises ApiInvalid or ApiConflict if somebody else was faster, other ApiErrors.
        """
        version = word(part(there, "metadata"), "resourceVersion")
        operations: list[Json] = [
            {"op": "test", "path": "/metadata/resourceVersion", "value": version},
            {"op": "add", "path": "/data", "value": {**part(there, "data"), **entries}},
        ]
        self.patch("secrets", name, operations)

    def _items(self, found: Found) -> list[Found]:
        items = found.get("items")
        if not isinstance(items, list):
            raise ApiAway(f"what answers at {self.server} is no API server")
        return [item for item in items if isinstance(item, dict)]

    def _ask(
        self,
        method: str,
        path: str,
        query: Mapping[str, str] | None = None,
        body: Json | list[Json] | None = None,
        within: Timeout = WITHIN,
    ) -> Found:
        patch = isinstance(body, list)
        headers = {
            "Accept": "application/json",
            "Content-Type": "application/json-patch+json" if patch else "application/json",
        }
        try:
            request = self._client.param_serialize(
                method,
                path,
                query_params=[*(query or {}).items()],
                header_params=headers,
                body=body,
                auth_settings=["BearerToken"],
            )
            answer: Any = self._client.call_api(*request, _request_timeout=within)
            status, reason, data = int(answer.status), answer.reason, bytes(answer.read())
        except (HTTPError, ApiException, ConfigException, OSError) as error:
            text = " ".join(str(error).split())[:200] or type(error).__name__
            text = f"the API server at {self.server} can't be reached: {text}"
            raise ApiAway(text) from error
        if not 200 <= status <= 299:
            raise refusal(status, str(reason or ""), data)
        try:
            return msgspec.json.decode(data, type=Found)
        except (msgspec.DecodeError, UnicodeDecodeError):
            raise ApiAway(f"what answers at {self.server}{path} is no API server") from None


def _configuration() -> Any:
    """How to reach the API server. Raises ApiError."""
    configuration = Configuration()
    try:
        if os.environ.get("KUBERNETES_SERVICE_HOST"):
            load_incluster_config(client_configuration=configuration)  # type: ignore[no-untyped-call]
        else:
            load_kube_config(client_configuration=configuration)  # type: ignore[no-untyped-call]
    except (ConfigException, OSError) as error:
        raise ApiAway(
            f"no cluster is known here ({error}): run it in a pod with a service account, or name "
            "a kubeconfig (KUBECONFIG)"
        ) from error
    # Whoever asks tries again, and is to know at once.
    configuration.retries = False
    configuration.connection_pool_maxsize = _CONNECTIONS
    return configuration


def _path(kind: str, namespace: str, name: str = "") -> str:
    """Where objects of a kind, or one of them or a part of it as ``kind/part``, are found."""
    kind, _, part = kind.partition("/")
    where = ["namespaces", namespace, kind, name, part] if namespace else [kind, name, part]
    return "/".join([_ROOTS.get(kind, "/api/v1"), *(quote(one, safe="") for one in where if one)])


def refusal(status: int, reason: str, body: bytes) -> ApiError:
    """The error for what the API server answered: HTTP status, reason phrase, body."""
    message = _message(body) or reason
    kind = _KINDS.get(status, ApiAway if status >= 500 else ApiError)
    if status == 403:  # by a role, or by an admission plug-in that has looked at the object
        if rule := missing_rule(message):
            return ApiError(f"{rule} ({message})")
        return ApiGone(message) if _TERMINATING in message else ApiInvalid(message)
    if status == 422 and message == _TEST_FAILED:
        return ApiConflict("the object has changed meanwhile")
    if status == 401:
        message = f"the API server does not know the operator's token or certificate ({message})"
    elif kind is ApiAway:
        message = f"the API server answers HTTP {status}: {message}"
    return kind(message)


def missing_rule(message: str) -> str:
    """The rule that the operator's role lacks, by the API server's words; empty if it is none."""
    found = _RBAC.search(message)
    if found is None:
        return ""
    where = f" in the namespace {found['namespace']}" if found["namespace"] else ""
    return (
        f"the operator's role lacks a rule{where}: "
        f'apiGroups ["{found["group"]}"], resources ["{found["resource"]}"], '
        f'verbs ["{found["verb"]}"]'
    )


def _message(body: bytes) -> str:
    """The message of the ``Status`` object with which the API server refuses."""
    text = body.decode(errors="replace")
    with contextlib.suppress(ValueError, KeyError, TypeError):  # something else has answered
        text = str(json.loads(text)["message"])
    return " ".join(text.split())[:_LONGEST]
