"""A small API server on loopback: objects in a dictionary, and the HTTP of Kubernetes.

The server has the kinds that the operator and kopf need. `refuse` makes a request fail.
"""

import asyncio
import copy
import itertools
import json
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import jsonpatch
from aiohttp import web

Object = dict[str, Any]
PLURALS = {
    "namespaces": "Namespace",
    "nodes": "Node",
    "pods": "Pod",
    "services": "Service",
    "events": "Event",
    "secrets": "Secret",
    "rosproxies": "RosProxy",
    "networkpolicies": "NetworkPolicy",
    "leases": "Lease",
    "mutatingwebhookconfigurations": "MutatingWebhookConfiguration",
    "endpointslices": "EndpointSlice",
}
GROUPS = {
    "rosproxies": "rosproxy.io/v1alpha1",
    "networkpolicies": "networking.k8s.io/v1",
    "leases": "coordination.k8s.io/v1",
    "mutatingwebhookconfigurations": "admissionregistration.k8s.io/v1",
    "endpointslices": "discovery.k8s.io/v1",
}


class ApiServer:
    """The server and its objects. ``requests`` are (method, path, query) in order."""

    def __init__(self) -> None:
        self.objects: dict[tuple[str, str, str], Object] = {}
        self.requests: list[tuple[str, str, dict[str, str]]] = []
        self.bodies: list[Any] = []
        self.refusals: dict[tuple[str, str], tuple[int, str]] = {}
        self.address_refusals = Counter[str]()  # remaining refusals for each address
        self.gone_for_watches = False
        self.granted = set[str]()  # the users that a SubjectAccessReview allows
        self.retry_after = ""
        self.admit: Callable[[Object], Object] = lambda obj: obj  # the webhook, in a dry run
        self.warning = ""  # of a dry run
        self.url = ""
        self._numbers = itertools.count(1)
        self._watches: list[tuple[str, str, asyncio.Queue[Object]]] = []
        self._past: list[tuple[int, str, str, Object]] = []

    def put(self, kind: str, obj: Object, namespace: str = "ns") -> Object:
        """Store an object, and send an event to all watches."""
        meta = obj.setdefault("metadata", {})
        if kind not in ("nodes", "mutatingwebhookconfigurations"):
            meta.setdefault("namespace", namespace)
        meta.setdefault("uid", f"uid-{next(self._numbers)}")
        meta.setdefault("creationTimestamp", "2026-01-01T00:00:00Z")
        key = kind, meta.get("namespace", ""), meta["name"]
        event = "MODIFIED" if key in self.objects else "ADDED"
        return self._hold(event, key, {"apiVersion": "v1", "kind": PLURALS[kind], **obj})

    def drop(self, kind: str, name: str, namespace: str = "ns") -> None:
        """Delete an object, and send an event to all watches."""
        key = kind, "" if kind == "nodes" else namespace, name
        self._hold("DELETED", key, self.objects[key])

    def forget(self, kind: str, name: str, namespace: str = "ns") -> None:
        """Delete an object without an event."""
        del self.objects[kind, "" if kind == "nodes" else namespace, name]

    def get(self, kind: str, name: str, namespace: str = "ns") -> Object:
        return self.objects[kind, namespace, name]

    def all(self, kind: str) -> list[Object]:
        return [obj for key, obj in self.objects.items() if key[0] == kind]

    def refuse(self, method: str, kind: str, status: int, message: str) -> None:
        self.refusals[method, kind] = status, message

    def asked(self, method: str, kind: str) -> list[dict[str, str]]:
        """The queries of all requests of a method about a kind."""
        return [q for m, path, q in self.requests if m == method and kind in path.split("/")]

    def _hold(self, event: str, key: tuple[str, str, str], obj: Object) -> Object:
        obj["metadata"]["resourceVersion"] = str(next(self._numbers))
        self.objects[key] = obj
        if event == "DELETED":
            del self.objects[key]
        told = {"type": event, "object": copy.deepcopy(obj)}
        self._past.append((int(obj["metadata"]["resourceVersion"]), key[0], key[1], told))
        for kind, namespace, queue in self._watches:
            if kind == key[0] and namespace in ("", key[1]):
                queue.put_nowait(told)
        return obj

    async def serve(self, request: web.Request) -> web.StreamResponse:
        parts = request.path.strip("/").split("/")
        self.requests.append((request.method, request.path, dict(request.query)))
        if request.path in ("/api", "/apis"):
            return web.json_response(_discovery(request.path))
        del parts[: 2 if parts[0] == "api" else 3]
        if not parts:
            return web.json_response(_resources(request.path))
        namespace = ""
        if parts[0] == "namespaces":
            namespace = parts[1]
            parts = parts[2:]
        kind, name, sub = (*parts, "", "")[:3]
        refusal = self.refusals.get((request.method, kind))
        if refusal:
            response = _status(*refusal)
            if self.retry_after:
                response.headers["Retry-After"] = self.retry_after
            return response
        if request.query.get("watch"):
            return await self._watch(request, kind, namespace)
        body: Any = await request.json() if request.can_read_body else None
        self.bodies.append(body)
        if request.query.get("dryRun"):
            warnings = {"Warning": f'299 - "{self.warning}"'} if self.warning else {}
            return web.json_response(self.admit(body), status=201, headers=warnings)
        return self._answer(request, (kind, namespace, name), sub, body)

    def _answer(
        self, request: web.Request, key: tuple[str, str, str], sub: str, body: Any
    ) -> web.Response:
        kind, namespace, name = key
        if request.method == "POST" and sub == "eviction":
            must = body["deleteOptions"]
            return self._delete(key, sub, must) if key in self.objects else _status(404, "gone")
        if kind == "subjectaccessreviews":
            return web.json_response({"status": {"allowed": body["spec"]["user"] in self.granted}})
        if request.method == "POST":
            return self._create(kind, namespace, body)
        if not name:
            return self._list(kind, namespace, request.query)
        if key not in self.objects:
            return _status(404, f'{kind} "{name}" not found')
        return {"DELETE": self._delete, "PATCH": self._patch}.get(request.method, self._get)(
            key, sub, body
        )

    def _get(self, key: tuple[str, str, str], sub: str, body: Any) -> web.Response:
        return web.json_response(self.objects[key])

    def _delete(self, key: tuple[str, str, str], sub: str, body: Any) -> web.Response:
        metadata = self.objects[key]["metadata"]
        for name, value in (body or {}).get("preconditions", {}).items():
            if value != metadata[name]:
                return _status(409, f"Precondition failed: {name} in precondition: {value}")
        self.drop(key[0], key[2], key[1])
        return web.json_response({"kind": "Status", "status": "Success"})

    def _create(self, kind: str, namespace: str, body: Object) -> web.Response:
        key = kind, namespace, body["metadata"]["name"]
        if key in self.objects:
            return _status(409, f'{kind} "{key[2]}" already exists')
        if kind == "services":
            address = body["spec"].setdefault("clusterIP", "10.96.0.7")
            if self.address_refusals[address] > 0:
                self.address_refusals[address] -= 1
                return _status(422, f"spec.clusterIPs: failed to allocate IP {address}: in use")
        return web.json_response(self.put(kind, body, namespace), status=201)

    def _patch(self, key: tuple[str, str, str], sub: str, body: Any) -> web.Response:
        try:
            patched = jsonpatch.apply_patch(self.objects[key], body)
        except jsonpatch.JsonPatchException:
            return _status(422, "the server rejected our request due to an error in our request")
        if sub == "status":
            patched = {**self.objects[key], "status": patched["status"]}
        return web.json_response(self._hold("MODIFIED", key, patched))

    def _list(self, kind: str, namespace: str, query: Any) -> web.Response:
        items = [
            obj
            for (stored_kind, stored_namespace, _), obj in self.objects.items()
            if stored_kind == kind
            and namespace in ("", stored_namespace)
            and _labelled(query.get("labelSelector", ""), obj["metadata"].get("labels", {}))
            and _has_fields(query.get("fieldSelector", ""), obj)
        ]
        meta = {"resourceVersion": str(next(self._numbers))}
        first = int(query.get("continue") or 0)
        limit = int(query.get("limit") or 10**6)
        if len(items) > first + limit:
            meta["continue"] = str(first + limit)
        page = items[first : first + limit]
        return web.json_response({"kind": "List", "metadata": meta, "items": page})

    async def _watch(self, request: web.Request, kind: str, namespace: str) -> web.StreamResponse:
        response = web.StreamResponse()
        await response.prepare(request)
        queue: asyncio.Queue[Object] = asyncio.Queue()
        if self.gone_for_watches:
            error = {"kind": "Status", "code": 410, "message": "too old resource version"}
            queue.put_nowait({"type": "ERROR", "object": error})
        since = int(request.query.get("resourceVersion", "0"))
        for version, event_kind, event_namespace, event in self._past:
            if version > since and event_kind == kind and namespace in ("", event_namespace):
                queue.put_nowait(event)
        entry = kind, namespace, queue
        self._watches.append(entry)
        try:
            while True:
                event = await queue.get()
                if not event:
                    return response
                await response.write(json.dumps(event).encode() + b"\n")
                if event["type"] == "ERROR":
                    return response
        finally:
            self._watches.remove(entry)

    def watches(self, kind: str) -> int:
        """The number of open watches of a kind."""
        return sum(entry[0] == kind for entry in self._watches)

    def close_watches(self) -> None:
        """End all watches, as after a while."""
        self.end_watches({})

    def end_watches(self, event: Object) -> None:
        """Send the same event to all watches, for example an error."""
        for _, _, queue in self._watches:
            queue.put_nowait(event)


async def until(true: Callable[[], bool], seconds: float = 60.0) -> None:
    """Wait for something to be true."""
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        await asyncio.sleep(0.01)


@asynccontextmanager
async def serving(directory: Path, port: int = 0) -> AsyncIterator[ApiServer]:
    """An API server, and its kubeconfig in ``directory/config``."""
    server = ApiServer()
    async with listening(server, port):
        write_kubeconfig(directory / "config", server.url)
        yield server


@asynccontextmanager
async def listening(server: ApiServer, port: int = 0) -> AsyncIterator[None]:
    application = web.Application()
    application.router.add_route("*", "/{path:.*}", server.serve)
    # A watch ends with its client, as in the real server. Otherwise the count never falls.
    runner = web.AppRunner(application, shutdown_timeout=0.1, handler_cancellation=True)
    await runner.setup()
    await web.TCPSite(runner, "127.0.0.1", port).start()
    server.url = f"http://127.0.0.1:{runner.addresses[0][1]}"
    try:
        yield
    finally:
        await runner.cleanup()


def write_kubeconfig(file: Path, url: str) -> None:
    config = {
        "apiVersion": "v1",
        "kind": "Config",
        "current-context": "test",
        "clusters": [{"name": "test", "cluster": {"server": url}}],
        "contexts": [{"name": "test", "context": {"cluster": "test", "user": "test"}}],
        "users": [{"name": "test", "user": {"token": "secret"}}],
    }
    file.write_text(json.dumps(config))


def _status(code: int, message: str) -> web.Response:
    body = {"kind": "Status", "status": "Failure", "message": message, "code": code}
    return web.json_response(body, status=code)


def _labelled(selector: str, labels: dict[str, str]) -> bool:
    """Whether a selector fits: ``a``, ``a=b``, ``a in (b,c)`` and ``a notin (b,c)`` are known."""
    for requirement in filter(None, _parts(selector)):
        if " notin " in requirement:
            key, values = requirement.split(" notin ")
            if labels.get(key) in values.strip("()").split(","):
                return False
        elif " in " in requirement:
            key, values = requirement.split(" in ")
            if labels.get(key) not in values.strip("()").split(","):
                return False
        else:
            key, equals, value = requirement.partition("=")
            if key not in labels or (equals and labels[key] != value):
                return False
    return True


def _parts(selector: str) -> list[str]:
    depth = 0
    parts = [""]
    for letter in selector:
        depth += {"(": 1, ")": -1}.get(letter, 0)
        if letter == "," and not depth:
            parts.append("")
        else:
            parts[-1] += letter
    return parts


def _has_fields(selector: str, obj: Object) -> bool:
    for requirement in filter(None, selector.split(",")):
        path, _, value = requirement.partition("=")
        field: Any = obj
        for step in path.split("."):
            field = field.get(step, {}) if isinstance(field, dict) else {}
        if (field or "") != value:
            return False
    return True


def _discovery(path: str) -> Object:
    if path == "/api":
        return {"versions": ["v1"]}
    groups = {name.partition("/")[0]: name for name in GROUPS.values()}
    return {
        "groups": [
            {
                "name": group,
                "versions": [{"groupVersion": name, "version": name.partition("/")[2]}],
                "preferredVersion": {"groupVersion": name, "version": name.partition("/")[2]},
            }
            for group, name in groups.items()
        ]
    }


def _resources(path: str) -> Object:
    group = path.removeprefix("/apis/") if path.startswith("/apis/") else "v1"
    return {
        "resources": [
            {
                "name": plural,
                "singularName": kind.lower(),
                "kind": kind,
                "namespaced": plural not in ("nodes", "mutatingwebhookconfigurations"),
                "verbs": ["get", "list", "watch", "create", "delete", "patch"],
            }
            for plural, kind in PLURALS.items()
            if GROUPS.get(plural, "v1") == group
        ]
    }
