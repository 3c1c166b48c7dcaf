"""The API server as far as the operator needs it: a thin layer over the `kubernetes` client.

The operator's service account has exactly these rights. Those of the second group are for single
objects, by name::

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

Objects go in and out as JSON: the client's models would drop fields that are newer than they are.
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
"""Seconds to connect and to wait for an answer."""
SOON: Timeout = (1.0, 2.0)
"""The same while somebody waits for a pod to be admitted, or a Lease runs out."""
ONCE: Timeout = (3.0, 10.0)
"""The same where 429 is an answer: a PodDisruptionBudget does not allow it now."""
WATCHED_FOR = 300
"""Seconds after which the API server is to end a watch; another one goes on from there."""
SILENT: Timeout = (3.0, 90.0)
"""Seconds to connect for a watch, and without a word on it: a bookmark comes every minute."""
PAGE = 500
"""Objects in one answer to a list, if they have no more than `LONGEST_PAGE` together."""
LONGEST_PAGE = 16 * 1024 * 1024
"""Bytes of such an answer. 500 pods have 5 MB as a rule, but the API server takes one of 1.5 MB
(etcd, --max-request-bytes), and any user that creates pods could fill the operator's memory."""
TRIES = 4
"""How often a request is sent that the API server puts off (429)."""
LONGEST_PAUSE = 10.0
"""Seconds that it may put it off at a time."""
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
"""The API's paths for kinds that are not of the core group."""
_ACCOUNTS = "system:serviceaccounts"
"""The group of all service accounts."""
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


class ApiUnavailable(ApiError):
    """The API server can't be reached, or is not ready to answer."""


class NotLeading(ApiUnavailable):
    """This operator does not lead: nothing was asked."""


class ApiNotFound(ApiError):
    """The object is not there, or the namespace is about to go that it is to be in."""


class ApiConflict(ApiError):
    """The name is taken, or the object is another one by now."""


class ApiInvalid(ApiError):
    """The object is not one that the API server takes."""


class ApiLost(ApiUnavailable):
    """A watch has ended before its time: it goes on where it was."""


class ApiExpired(ApiError):
    """A list or a watch can't go on from where it was (410): list anew."""


class Page(msgspec.Struct, frozen=True):
    """A part of a list: the next one is asked for with ``continue_token``, empty for the last.

    ``version`` is that of the whole list: a watch goes on from there.
    """

    items: Iterable[JsonObject]
    version: str
    continue_token: str


class _Listing(msgspec.Struct, frozen=True):
    """A part of a list, as the API server answers."""

    items: list[msgspec.Raw]
    metadata: dict[str, Any] = {}


class Event(msgspec.Struct, frozen=True):
    """What a watch tells: ADDED, MODIFIED, DELETED, BOOKMARK (a version alone) or ERROR."""

    type: str
    object: JsonObject


class Watch:
    """A watch that is open. Iterating gives events as they come, and ends with the watch."""

    def __init__(self, response: Any) -> None:
        self._response = response

    def __iter__(self) -> Iterator[list[Event]]:
        """Give events, those together that came together. Raises ApiLost."""
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
        """End it, also from another thread."""
        with contextlib.suppress(ValueError, RuntimeError, OSError):  # it has just ended
            self._response.shutdown()


_EVENT = msgspec.json.Decoder(Event)


_KINDS: Mapping[int, type[ApiError]] = {
    400: ApiInvalid,
    401: ApiUnavailable,  # the token has just been replaced, or the server does not know it yet
    404: ApiNotFound,
    409: ApiConflict,
    410: ApiExpired,
    422: ApiInvalid,
    429: ApiUnavailable,
}


class Api:
    """The cluster that this process runs in, else the one that KUBECONFIG names.

    Any thread may use it. Every method raises ApiError. ``namespaces``: looked after; none: all.
    Nothing is changed, but for Leases, while the `Gate` is closed: NotLeading.
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
        """All RosProxies, or those of a namespace, as they are at this moment."""
        places = (namespace,) if namespace else self._places
        try:
            lists = [self._ask("GET", _path(PLURAL, place), within=within) for place in places]
        except ApiNotFound:
            raise ApiNotFound(crd_missing(PLURAL)) from None
        return [obj for listing in lists for obj in self._items(listing)]

    def own_pods(self) -> list[JsonObject]:
        """The pods that the operator has made."""
        lists = (self.list_fresh("pods", place, labels=OWN_SELECTOR) for place in self._places)
        return [obj for objs in lists for obj in objs]

    def namespaces_of(self, kind: str) -> tuple[str, ...]:
        """The namespaces in which a kind is watched; an empty one stands for all of them.

        Others' pods and Services count as well, so those are watched in all of the cluster.
        """
        return self._places if kind in (PLURAL, POLICIES) else ("",)

    def page(self, kind: str, place: str, token: str = "", fields: str = "") -> Page:
        """A part of the list of a kind, as it is now. Raises ApiExpired, too.

        ``fields`` is a selector. The items are decoded one at a time: decoded, they take ten times
        as much memory.
        """
        limit = PAGE
        path = _path(kind, place)
        data = None
        while data is None:
            query = {"limit": str(limit), **_watched(kind), "continue": token}
            query["fieldSelector"] = fields
            longest = LONGEST_PAGE if limit > 1 else None
            data = self._data("GET", path, query, longest=longest)
            limit = max(limit // 8, 1)
        try:
            listing = msgspec.json.decode(data, type=_Listing)
        except (msgspec.DecodeError, UnicodeDecodeError):
            raise self._no_server(path) from None
        meta = listing.metadata
        version = text_at(meta, "resourceVersion")
        next_token = text_at(meta, "continue")
        return Page(self._decoded(listing.items, path), version, next_token)

    def each(self, kind: str, place: str, fields: str) -> Iterator[JsonObject]:
        """The objects that a selector fits, as they are now, one at a time; as `page`."""
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
                raise self._no_server(path) from None

    def watch(self, kind: str, place: str, version: str) -> Watch:
        """What happens to a kind after a version of its list. Raises ApiExpired, too."""
        query = {"watch": "1", "resourceVersion": version, "allowWatchBookmarks": "true"}
        query |= _watched(kind) | {"timeoutSeconds": str(WATCHED_FOR)}
        answer = self._send("GET", _path(kind, place), query, within=SILENT)
        if answer.status != 200:
            body = self._body(answer) or b""
            raise refusal(int(answer.status), str(answer.reason or ""), body)
        return Watch(answer.response)

    def list_fresh(
        self, kind: str, namespace: str, fields: str = "", labels: str = ""
    ) -> list[JsonObject]:
        """The objects that both selectors fit, as they are now in the API server's store."""
        # Without a resourceVersion a list is "most recent", as the docs of Kubernetes have it (API
        # Concepts). The operator has no right to `get` nodes and RosProxies.
        query = {"fieldSelector": fields, "labelSelector": labels}
        return self._items(self._ask("GET", _path(kind, namespace), query))

    def get(self, kind: str, id: Name, within: Timeout = WITHIN) -> JsonObject:
        """One object, for example of the kind ``services``."""
        return self._ask("GET", _path(kind, id.namespace, id.name), within=within)

    def create(self, kind: str, body: Json, within: Timeout = WITHIN) -> None:
        """Create an object in the namespace that it names."""
        self._ask("POST", _path(kind, body["metadata"]["namespace"]), body=body, within=within)

    def may_patch_status(self, account: Name, namespace: str) -> bool:
        """Whether a service account may write the status of a namespace's RosProxies.

        Only the doctor asks, with the rights of its user.
        """
        groups = [_ACCOUNTS, f"{_ACCOUNTS}:{account.namespace}", "system:authenticated"]
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
        """Delete an object if it still has this uid, and this version if one is given."""
        preconditions = {"uid": uid, **({"resourceVersion": version} if version else {})}
        options = {"apiVersion": "v1", "kind": "DeleteOptions", "preconditions": preconditions}
        self._ask("DELETE", _path(kind, id.namespace, id.name), body=options)

    def evict(self, id: Name, uid: str) -> None:
        """Delete a pod if it has this uid. ApiUnavailable: a PodDisruptionBudget forbids it."""
        body = {
            "apiVersion": "policy/v1",
            "kind": "Eviction",
            "metadata": {"namespace": id.namespace, "name": id.name},
            "deleteOptions": {"preconditions": {"uid": uid}},
        }
        self._ask("POST", _path("pods/eviction", id.namespace, id.name), body=body, within=ONCE)

    def patch(self, kind: str, id: Name, operations: list[Json], within: Timeout = WITHIN) -> None:
        """Change an object, or a part of it as ``rosproxies/status``, by a JSON patch."""
        self._ask("PATCH", _path(kind, id.namespace, id.name), body=operations, within=within)

    def fill_secret(self, name: Name, secret: Json, entries: Mapping[str, str]) -> None:
        """Write entries (in base64) into a Secret, if it is as it was when it was read.

        Raises ApiInvalid or ApiConflict if somebody else was faster, other ApiErrors.
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
            raise self._no_server()
        return [item for item in items if isinstance(item, dict)]

    def _ask(
        self,
        method: str,
        path: str,
        query: Mapping[str, str] | None = None,
        body: Json | list[Json] | None = None,
        within: Timeout = WITHIN,
    ) -> JsonObject:
        data = self._data(method, path, query, body, within) or b""
        try:
            return msgspec.json.decode(data, type=JsonObject)
        except (msgspec.DecodeError, UnicodeDecodeError):
            raise self._no_server(path) from None

    def _no_server(self, path: str = "") -> ApiUnavailable:
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
        """The body of the answer; None if it has more than ``longest`` bytes."""
        answer = self._send_with_retries(method, path, query, body, within)
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
        """The answer; where it puts callers off (429: nothing was begun) asked again, as it says.

        Callers that have little time try again themselves.
        """
        for _ in range(TRIES if within is WITHIN else 1):
            answer = self._send(method, path, query, body, within)
            retry_after = str(answer.getheader("Retry-After", ""))
            if answer.status != 429 or not retry_after.isdecimal():
                break
            self._body(answer)
            time.sleep(min(float(retry_after), LONGEST_PAUSE))
        return answer

    def _send(
        self,
        method: str,
        path: str,
        query: Mapping[str, str] | None = None,
        body: Json | list[Json] | None = None,
        within: Timeout = WITHIN,
    ) -> Any:
        """The answer, of which the body is yet to be read. Raises ApiUnavailable."""
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
            # Leases are written by operators that do not lead yet.
            if method == "GET" or path.startswith(_ROOTS[LEASES]):
                return self._client.call_api(*request, _request_timeout=within)
            with self.gate.passing() as may_send:
                if not may_send:
                    raise NotLeading("this operator does not lead")
                return self._client.call_api(*request, _request_timeout=within)
        except (HTTPError, ApiException, ConfigException, OSError) as error:
            raise self._away(error) from error

    def _body(self, answer: Any, longest: int | None = None) -> bytes | None:
        """The body of an answer; None if it has more than ``longest`` bytes."""
        try:
            # The answer to a caller that is put off has been read before.
            if longest is None or answer.data is not None:
                return bytes(answer.read())
            data = bytes(answer.response.read(longest + 1))
            if len(data) <= longest:
                return data
            answer.response.close()
            return None
        except (HTTPError, OSError) as error:
            raise self._away(error) from error

    def _away(self, error: Exception) -> ApiUnavailable:
        text = " ".join(str(error).split())[:200] or type(error).__name__
        return ApiUnavailable(f"the API server at {self.server} can't be reached: {text}")


def _watched(kind: str) -> dict[str, str]:
    """The query for the objects of a kind that are watched: of NetworkPolicies only our own."""
    return {"labelSelector": OWN_SELECTOR} if kind == POLICIES else {}


def _path(kind: str, namespace: str, name: str = "") -> str:
    """The path of a kind's objects, of one of them, or of a subresource (``pods/eviction``)."""
    kind, _, sub = kind.partition("/")
    segments = ["namespaces", namespace, kind, name, sub] if namespace else [kind, name, sub]
    return "/".join([_ROOTS.get(kind, "/api/v1"), *(quote(s, safe="") for s in segments if s)])


def crd_missing(kind: str) -> str:
    """What to do about a kind that does not exist at all; empty for those that always do."""
    if kind != PLURAL:
        return ""
    return (
        f"the CustomResourceDefinition {PLURAL}.{GROUP} is not installed. Install the chart "
        "rosproxy, or apply manifests/; both contain the definition"
    )


def refusal(status: int, reason: str, body: bytes) -> ApiError:
    """The error for what the API server answered: HTTP status, reason phrase, body."""
    message = _message(body) or reason
    kind = _KINDS.get(status, ApiUnavailable if status >= 500 else ApiError)
    if status == 403:  # by a role, or by an admission plug-in that has looked at the object
        if rule := missing_rule(message):
            return ApiError(f"{rule} ({message})")
        return ApiNotFound(message) if _TERMINATING in message else ApiInvalid(message)
    if status == 422 and message == _TEST_FAILED:
        return ApiConflict("the object has changed meanwhile")
    if status == 401:
        message = f"the API server does not accept the operator's token or certificate ({message})"
    elif kind is ApiUnavailable:
        message = f"the API server answers HTTP {status}: {message}"
    return kind(message)


def _message(body: bytes) -> str:
    """The message of the ``Status`` object with which the API server refuses."""
    text = body.decode(errors="replace")
    with contextlib.suppress(ValueError, KeyError, TypeError):  # something else has answered
        text = str(json.loads(text)["message"])
    return " ".join(text.split())[:_LONGEST]
