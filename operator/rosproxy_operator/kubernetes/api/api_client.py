"""The requests that the operator sends to the API server: a thin layer over `kubernetes`.

The operator's service account has exactly these rights. The rights of the second group are for
single objects, by name. The right to create leases is an exception, since RBAC can't restrict a
creation to a name::

    nodes                   list watch
    pods                    get list watch create delete patch
    pods/eviction           create
    services                get list watch create delete
    networkpolicies         get list watch create patch delete
    events                  get list create patch
    rosproxies              list watch
    rosproxies/status       patch

    secrets                                get patch
    mutatingwebhookconfigurations          get patch
    leases                                 get create patch

Arguments and results are JSON: the client's models would drop fields that are newer than the
client. The doctor calls some methods with the rights of its user.
"""

import contextlib
import json
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any
from urllib.parse import quote

import msgspec
from kubernetes.client import ApiClient
from kubernetes.client.exceptions import ApiException
from kubernetes.config import ConfigException
from urllib3.exceptions import HTTPError

from rosproxy import __version__
from rosproxy_operator.kubernetes.api.kubeconfig import NoCluster, configuration
from rosproxy_operator.kubernetes.api.leader_gate import Gate
from rosproxy_operator.kubernetes.api.rbac import missing_rule
from rosproxy_operator.kubernetes.resources.checks import submap, text_at
from rosproxy_operator.kubernetes.resources.model import Json, Name
from rosproxy_operator.kubernetes.resources.names import GROUP, OWN_SELECTOR, PLURAL, VERSION

JsonObject = dict[str, Any]
Timeout = tuple[float, float]
WITHIN: Timeout = (3.0, 15.0)
"""Seconds to connect, and seconds to wait for an answer."""
SOON: Timeout = (1.0, 2.0)
"""The same while a pod waits for the webhook, or while a Lease object runs out."""
EVICTION_TIMEOUT_S: Timeout = (3.0, 10.0)
"""The same for an eviction, without a retry after HTTP 429.

The answer HTTP 429 means here that a PodDisruptionBudget forbids the eviction now.
"""
WATCH_DURATION_S = 300
"""Seconds after which the API server ends a watch. The next watch continues from there."""
WATCH_TIMEOUT_S: Timeout = (3.0, 90.0)
"""Seconds to connect for a watch, and seconds of silence. A bookmark comes every minute."""
MOST_PAGE_ITEMS = 500
"""Most objects in an answer to a list request; fewer if they exceed `MOST_PAGE_BYTES`."""
MOST_PAGE_BYTES = 16 * 1024 * 1024
"""Most bytes of such an answer, unless a single object has more.

500 pods usually have 5 MB. But the API server accepts a pod of 1.5 MB (etcd, --max-request-bytes).
So without this bound, any user that creates pods could fill the operator's memory.
"""
MOST_TRIES = 4
"""Most times that the operator sends a request while the API server answers HTTP 429."""
MOST_RETRY_PAUSE_S = 10.0
"""Most seconds to wait after such an answer, whatever Retry-After says."""
WEBHOOKS = "mutatingwebhookconfigurations"
POLICIES = "networkpolicies"
LEASES = "leases"
ENDPOINTS = "endpointslices"
REVIEWS = "subjectaccessreviews"
_ROOTS = {
    PLURAL: f"/apis/{GROUP}/{VERSION}",
    WEBHOOKS: "/apis/admissionregistration.k8s.io/v1",
    POLICIES: "/apis/networking.k8s.io/v1",
    LEASES: "/apis/coordination.k8s.io/v1",
    ENDPOINTS: "/apis/discovery.k8s.io/v1",
    REVIEWS: "/apis/authorization.k8s.io/v1",
}
"""The API's paths for kinds outside the core group."""
_ACCOUNTS_GROUP = "system:serviceaccounts"
"""The group of all service accounts."""
_NAMESPACE_TERMINATING = "because it is being terminated"
"""Part of the refusal when the operator creates an object in a namespace that is being deleted.

The admission plug-in NamespaceLifecycle refuses. The operator needs no object there.
"""
_TEST_FAILED = "the server rejected our request due to an error in our request"
"""The whole message of the API server when a ``test`` of a JSON patch fails."""
_MOST_MESSAGE_CHARACTERS = 500


class ApiError(Exception):
    """A request to the API server failed. The message is a single line.

    A subclass gives the reason if callers treat that reason differently.
    """


class ApiUnavailable(ApiError):
    """The API server can't be reached, or is not ready to answer."""


class NotLeading(ApiUnavailable):
    """This operator does not lead. The request was not sent."""


class ApiNotFound(ApiError):
    """The object does not exist, or the namespace for a new object is being deleted."""


class ApiConflict(ApiError):
    """The name is taken, or the object is no longer the expected object or version."""


class ApiInvalid(ApiError):
    """The API server refuses the object or the request as invalid."""


class ApiLost(ApiUnavailable):
    """A watch has ended early. The caller continues from the last version."""


class ApiExpired(ApiError):
    """A list or watch can't continue from the last version (HTTP 410). List again."""


class Page(msgspec.Struct, frozen=True):
    """A page of a list. ``continue_token`` requests the next page; empty for the last page.

    A watch continues from ``version``, the resourceVersion of the whole list.
    """

    items: Iterable[JsonObject]
    version: str
    continue_token: str


class _Listing(msgspec.Struct, frozen=True):
    """A page of a list, as the API server answers."""

    items: list[msgspec.Raw]
    metadata: dict[str, Any] = {}


class Event(msgspec.Struct, frozen=True):
    """An event of a watch: ADDED, MODIFIED, DELETED, BOOKMARK (only a version) or ERROR."""

    type: str
    object: JsonObject


class Watch:
    """An open watch. The iteration yields lists of events, and ends with the watch."""

    def __init__(self, response: Any) -> None:
        self._response = response

    def __iter__(self) -> Iterator[list[Event]]:
        """Yield the events of each received chunk as a list. Raises ApiLost."""
        partial = b""
        try:
            for chunk in self._response.stream():
                *lines, partial = (partial + chunk).split(b"\n")
                yield [_EVENT.decode(line) for line in lines if line]
        except (HTTPError, OSError, msgspec.DecodeError, UnicodeDecodeError, ValueError) as error:
            raise ApiLost(f"watch lost: {' '.join(str(error).split())[:200]}") from error
        finally:
            self._response.close()

    def stop(self) -> None:
        """End the watch. Safe in any thread."""
        with contextlib.suppress(ValueError, RuntimeError, OSError):  # the watch has just ended
            self._response.shutdown()


_EVENT = msgspec.json.Decoder(Event)


_ERRORS_BY_STATUS: Mapping[int, type[ApiError]] = {
    400: ApiInvalid,
    401: ApiUnavailable,  # a token that was just replaced, or that the server does not know yet
    404: ApiNotFound,
    409: ApiConflict,
    410: ApiExpired,
    422: ApiInvalid,
    429: ApiUnavailable,
}


class Api:
    """The cluster of this pod, or else of the kubeconfig file. Safe in any thread.

    Each failed request raises ApiError; without a cluster, the creation raises ApiUnavailable.
    ``namespaces`` are the managed namespaces; none means all. ``place`` is a namespace; empty means
    all. ``within`` has the seconds to connect, and to wait for an answer.

    While the `Gate` is closed, each request that changes something raises NotLeading. Requests for
    Lease objects are an exception.
    """

    def __init__(self, namespaces: Sequence[str] = ()) -> None:
        self._places = tuple(namespaces) or ("",)
        self.gate = Gate()
        try:
            settings = configuration()
        except NoCluster as error:
            raise ApiUnavailable(str(error)) from error
        self.server = str(settings.host)
        self._client = ApiClient(settings)
        self._client.user_agent = f"rosproxy-operator/{__version__}"

    def close(self) -> None:
        """Close all connections."""
        self._client.close()  # type: ignore[no-untyped-call]

    def rosproxies(self, namespace: str = "", within: Timeout = WITHIN) -> list[JsonObject]:
        """Return all managed RosProxies, or only the RosProxies of ``namespace``.

        The list comes from the API server's store, not from a cache. Raises ApiNotFound with a fix
        if the cluster has no definition of RosProxies.
        """
        places = (namespace,) if namespace else self._places
        try:
            lists = [self._ask("GET", _path(PLURAL, place), within=within) for place in places]
        except ApiNotFound:
            raise ApiNotFound(crd_missing(PLURAL)) from None
        return [obj for listing in lists for obj in self._items(listing)]

    def own_pods(self) -> list[JsonObject]:
        """Return the pods that the operator has made, in the managed namespaces."""
        lists = (self.list_fresh("pods", place, labels=OWN_SELECTOR) for place in self._places)
        return [obj for objs in lists for obj in objs]

    def namespaces_of(self, kind: str) -> tuple[str, ...]:
        """Return the namespaces in which the operator watches a kind. Empty text means all.

        Pods and Services matter in the whole cluster: foreign pods hold ports, and a master's
        Service may be in any namespace.
        """
        return self._places if kind in (PLURAL, POLICIES) else ("",)

    def page(self, kind: str, place: str, token: str = "", fields: str = "") -> Page:
        """Return a page of the current list of a kind. Raises ApiExpired for an old ``token``.

        ``fields`` is a field selector. The items are decoded during the iteration, because decoded
        items take ten times as much memory. So the iteration raises ApiUnavailable if the API
        server's answer is not valid.
        """
        limit = MOST_PAGE_ITEMS
        path = _path(kind, place)
        data = None
        while data is None:
            query = {"limit": str(limit), **_watched(kind), "continue": token}
            query["fieldSelector"] = fields
            longest = MOST_PAGE_BYTES if limit > 1 else None
            data = self._data("GET", path, query, longest=longest)
            limit = max(limit // 8, 1)  # the answer was too long: ask for fewer objects
        try:
            listing = msgspec.json.decode(data, type=_Listing)
        except (msgspec.DecodeError, UnicodeDecodeError):
            raise self._not_an_api_server(path) from None
        meta = listing.metadata
        version = text_at(meta, "resourceVersion")
        next_token = text_at(meta, "continue")
        return Page(self._decoded(listing.items, path), version, next_token)

    def each(self, kind: str, place: str, fields: str) -> Iterator[JsonObject]:
        """Yield all objects that match a field selector, page by page. Raises as `page`."""
        token = ""
        while True:
            page = self.page(kind, place, token, fields)
            yield from page.items
            token = page.continue_token
            if not token:
                return

    def _decoded(self, items: Iterable[msgspec.Raw], path: str) -> Iterator[JsonObject]:
        for item in items:
            try:
                yield msgspec.json.decode(item, type=JsonObject)
            except (msgspec.DecodeError, UnicodeDecodeError):
                raise self._not_an_api_server(path) from None

    def watch(self, kind: str, place: str, version: str) -> Watch:
        """Watch the changes of a kind after ``version``. Raises ApiExpired for an old version."""
        query = {"watch": "1", "resourceVersion": version, "allowWatchBookmarks": "true"}
        query |= _watched(kind) | {"timeoutSeconds": str(WATCH_DURATION_S)}
        answer = self._send("GET", _path(kind, place), query, within=WATCH_TIMEOUT_S)
        if answer.status != 200:
            body = self._body(answer) or b""
            raise refusal(int(answer.status), str(answer.reason or ""), body)
        return Watch(answer.response)

    def list_fresh(
        self, kind: str, namespace: str, fields: str = "", labels: str = ""
    ) -> list[JsonObject]:
        """Return the objects that match both selectors, from the API server's store."""
        # Without a resourceVersion, a list is "most recent" (docs of Kubernetes, API Concepts). The
        # operator lists because it has no right to `get` nodes and RosProxies.
        query = {"fieldSelector": fields, "labelSelector": labels}
        return self._items(self._ask("GET", _path(kind, namespace), query))

    def get(self, kind: str, id: Name, within: Timeout = WITHIN) -> JsonObject:
        """Return an object. ``kind`` is the plural, such as ``services``."""
        return self._ask("GET", _path(kind, id.namespace, id.name), within=within)

    def create(self, kind: str, body: Json, within: Timeout = WITHIN) -> None:
        """Create an object in the namespace of its metadata."""
        self._ask("POST", _path(kind, body["metadata"]["namespace"]), body=body, within=within)

    def try_creation(self, kind: str, body: Json) -> tuple[JsonObject, str]:
        """Return the object that the API server would create (dry run), and the warnings.

        Only the doctor calls this, with the rights of its user.
        """
        path = _path(kind, body["metadata"]["namespace"])
        answer = self._send_with_retries("POST", path, {"dryRun": "All"}, body, WITHIN)
        data = self._checked(answer) or b""
        return self._object(data, path), str(answer.getheader("Warning", ""))

    def may_patch_status(self, account: Name, namespace: str) -> bool:
        """Whether a service account may write the status of RosProxies in a namespace.

        Only the doctor calls this, with the rights of its user.
        """
        groups = [_ACCOUNTS_GROUP, f"{_ACCOUNTS_GROUP}:{account.namespace}", "system:authenticated"]
        resource = {"verb": "patch", "group": GROUP, "resource": PLURAL, "subresource": "status"}
        spec = {
            "user": f"system:serviceaccount:{account.namespace}:{account.name}",
            "groups": groups,
            "resourceAttributes": {**resource, "namespace": namespace},
        }
        body = {
            "apiVersion": "authorization.k8s.io/v1",
            "kind": "SubjectAccessReview",
            "metadata": {},
            "spec": spec,
        }
        answer = self._ask("POST", _path(REVIEWS, ""), body=body)
        return submap(answer, "status").get("allowed") is True

    def delete(self, kind: str, id: Name, uid: str, version: str = "") -> None:
        """Delete an object if the uid and a given version still match. Else raises ApiConflict."""
        preconditions = {"uid": uid, **({"resourceVersion": version} if version else {})}
        options = {"apiVersion": "v1", "kind": "DeleteOptions", "preconditions": preconditions}
        self._ask("DELETE", _path(kind, id.namespace, id.name), body=options)

    def evict(self, id: Name, uid: str) -> None:
        """Evict a pod if the uid still matches.

        Raises ApiUnavailable if a PodDisruptionBudget forbids the eviction.
        """
        body = {
            "apiVersion": "policy/v1",
            "kind": "Eviction",
            "metadata": {"namespace": id.namespace, "name": id.name},
            "deleteOptions": {"preconditions": {"uid": uid}},
        }
        self._ask(
            "POST",
            _path("pods/eviction", id.namespace, id.name),
            body=body,
            within=EVICTION_TIMEOUT_S,
        )

    def patch(self, kind: str, id: Name, operations: list[Json], within: Timeout = WITHIN) -> None:
        """Change an object, or a subresource such as ``rosproxies/status``, by a JSON patch."""
        self._ask("PATCH", _path(kind, id.namespace, id.name), body=operations, within=within)

    def fill_secret(self, name: Name, secret: Json, entries: Mapping[str, str]) -> None:
        """Write entries (base64) into a Secret, if the Secret has not changed since the read.

        Raises ApiInvalid or ApiConflict if another program has changed the Secret.
        """
        version = text_at(submap(secret, "metadata"), "resourceVersion")
        operations: list[Json] = [
            {"op": "test", "path": "/metadata/resourceVersion", "value": version},
            {"op": "add", "path": "/data", "value": {**submap(secret, "data"), **entries}},
        ]
        self.patch("secrets", name, operations)

    def _items(self, listing: JsonObject) -> list[JsonObject]:
        items = listing.get("items")
        if not isinstance(items, list):
            raise self._not_an_api_server()
        return [item for item in items if isinstance(item, dict)]

    def _ask(
        self,
        method: str,
        path: str,
        query: Mapping[str, str] | None = None,
        body: Json | list[Json] | None = None,
        within: Timeout = WITHIN,
    ) -> JsonObject:
        return self._object(self._data(method, path, query, body, within) or b"", path)

    def _object(self, data: bytes, path: str) -> JsonObject:
        try:
            return msgspec.json.decode(data, type=JsonObject)
        except (msgspec.DecodeError, UnicodeDecodeError):
            raise self._not_an_api_server(path) from None

    def _not_an_api_server(self, path: str = "") -> ApiUnavailable:
        return ApiUnavailable(
            f"the program that answers at {self.server}{path} is not an API server"
        )

    def _data(
        self,
        method: str,
        path: str,
        query: Mapping[str, str] | None = None,
        body: Json | list[Json] | None = None,
        within: Timeout = WITHIN,
        longest: int | None = None,
    ) -> bytes | None:
        """Return the body of a successful answer; None if the body exceeds ``longest`` bytes."""
        return self._checked(self._send_with_retries(method, path, query, body, within), longest)

    def _checked(self, answer: Any, longest: int | None = None) -> bytes | None:
        """Return the body of an answer, as `_data` does. Raises ApiError for a refusal."""
        data = self._body(answer, longest)
        if data is not None and not 200 <= answer.status <= 299:
            raise refusal(int(answer.status), str(answer.reason or ""), data)
        return data

    def _send_with_retries(
        self,
        method: str,
        path: str,
        query: Mapping[str, str] | None,
        body: Json | list[Json] | None,
        within: Timeout,
    ) -> Any:
        """Return the answer. Send the request again after HTTP 429, as Retry-After says.

        HTTP 429 means that the API server has not begun the request. A caller with another
        ``within`` than `WITHIN` gets the answer at once, and tries again itself.
        """
        for _ in range(MOST_TRIES - 1 if within is WITHIN else 0):
            answer = self._send(method, path, query, body, within)
            retry_after = str(answer.getheader("Retry-After", ""))
            if answer.status != 429 or not retry_after.isdecimal():
                return answer
            self._body(answer)  # frees the connection
            time.sleep(min(float(retry_after), MOST_RETRY_PAUSE_S))
        return self._send(method, path, query, body, within)

    def _send(
        self,
        method: str,
        path: str,
        query: Mapping[str, str] | None = None,
        body: Json | list[Json] | None = None,
        within: Timeout = WITHIN,
    ) -> Any:
        """Return the answer with an unread body. Raises ApiUnavailable."""
        is_patch = isinstance(body, list)
        headers = {
            "Accept": "application/json",
            "Content-Type": "application/json-patch+json" if is_patch else "application/json",
        }
        try:
            request = self._client.param_serialize(
                method,
                path,
                query_params=[(name, value) for name, value in (query or {}).items() if value],
                header_params=headers,
                body=body,
                auth_settings=["BearerToken"],
            )
            # An operator that does not lead yet writes the Lease object to become the leader.
            if method == "GET" or path.startswith(_ROOTS[LEASES]):
                return self._client.call_api(*request, _request_timeout=within)
            with self.gate.passing() as may_send:
                if not may_send:
                    raise NotLeading("this operator does not lead")
                return self._client.call_api(*request, _request_timeout=within)
        except (HTTPError, ApiException, ConfigException, OSError) as error:
            raise self._unreachable(error) from error

    def _body(self, answer: Any, longest: int | None = None) -> bytes | None:
        """Return the body of an answer; None if the body exceeds ``longest`` bytes."""
        try:
            if longest is None:
                return bytes(answer.read())
            data = bytes(answer.response.read(longest + 1))
            if len(data) <= longest:
                return data
            answer.response.close()
            return None
        except (HTTPError, OSError) as error:
            raise self._unreachable(error) from error

    def _unreachable(self, error: Exception) -> ApiUnavailable:
        text = " ".join(str(error).split())[:200] or type(error).__name__
        return ApiUnavailable(f"the API server at {self.server} can't be reached: {text}")


def _watched(kind: str) -> dict[str, str]:
    """Return the selector of a list or watch: of NetworkPolicies, only the operator's own."""
    return {"labelSelector": OWN_SELECTOR} if kind == POLICIES else {}


def _path(kind: str, namespace: str, name: str = "") -> str:
    """Return the path of a kind's list, of an object, or of a subresource (``pods/eviction``)."""
    kind, _, sub = kind.partition("/")
    segments = ["namespaces", namespace, kind, name, sub] if namespace else [kind, name, sub]
    return "/".join([_ROOTS.get(kind, "/api/v1"), *(quote(s, safe="") for s in segments if s)])


def crd_missing(kind: str) -> str:
    """Return the error for RosProxies without a definition; empty for kinds that always exist."""
    if kind != PLURAL:
        return ""
    return (
        f"the CustomResourceDefinition {PLURAL}.{GROUP} is not installed. Install the chart "
        "rosproxy-operator, or apply manifests/; both contain the definition"
    )


def refusal(status: int, reason: str, body: bytes) -> ApiError:
    """Return the error for an answer of the API server: HTTP status, reason phrase, body."""
    message = _message(body) or reason
    error_type = _ERRORS_BY_STATUS.get(status, ApiUnavailable if status >= 500 else ApiError)
    if status == 403:  # from RBAC, or from an admission plug-in that refuses the object
        if rule := missing_rule(message):
            return ApiError(f"{rule} ({message})")
        return ApiNotFound(message) if _NAMESPACE_TERMINATING in message else ApiInvalid(message)
    if status == 422 and message == _TEST_FAILED:
        return ApiConflict("the object has changed meanwhile")
    if status == 401:
        message = f"the API server does not accept this program's token or certificate ({message})"
    elif error_type is ApiUnavailable:
        message = f"the API server answers HTTP {status}: {message}"
    return error_type(message)


def _message(body: bytes) -> str:
    """Return the message of the API server's ``Status`` object, or else the start of the body."""
    text = body.decode(errors="replace")
    with contextlib.suppress(ValueError, KeyError, TypeError):  # not a Status object
        text = str(json.loads(text)["message"])
    return " ".join(text.split())[:_MOST_MESSAGE_CHARACTERS]
