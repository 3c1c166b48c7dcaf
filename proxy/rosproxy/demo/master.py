"""A small ROS master: the real master API over XML-RPC, as ROS's own master answers it.

Run as a program (`python -m rosproxy.demo.master JSON`) it serves until its standard input ends.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rosproxy.demo import validate as v
from rosproxy.demo.book import Book
from rosproxy.demo.boundary import Boundary
from rosproxy.demo.params import UNSET, ParamTree, subscription_key, updates
from rosproxy.demo.rpc import CALL_ERRORS, RpcServer, call

Triple = tuple[int, str, Any]


@dataclass(frozen=True)
class Method:
    """One row of the master API: what to run, how to check parameters, what a failure returns."""

    run: Callable[..., Triple]
    failure: Any
    checks: tuple[tuple[str, v.Validator], ...] = ()


class Notifier:
    """Calls nodes back in the background: in order for each node, one call at a time."""

    def __init__(self, boundary: Boundary) -> None:
        self._boundary = boundary
        self._lock = threading.Lock()
        self._waiting: dict[str, deque[tuple[Any, ...]]] = {}

    def post(self, api: str, method: str, *args: Any) -> None:
        """Have `method(*args)` called at the node `api`; a node that is gone is ignored."""
        with self._lock:
            if api in self._waiting:
                self._waiting[api].append((method, *args))
                return
            self._waiting[api] = deque([(method, *args)])
        threading.Thread(target=self._drain, args=(api,), daemon=True).start()

    def _drain(self, api: str) -> None:
        while (task := self._next(api)) is not None:
            try:
                call(self._boundary, api, *task)
            except CALL_ERRORS:
                continue

    def _next(self, api: str) -> tuple[Any, ...] | None:
        with self._lock:
            if self._waiting[api]:
                return self._waiting[api].popleft()
            del self._waiting[api]
            return None


class Master:
    """The master API on a free port of `address`; `close` stops it."""

    def __init__(self, address: str, boundary: Boundary) -> None:
        self._book = Book()
        self._params = ParamTree()
        self._lock = threading.Lock()
        self._notifier = Notifier(boundary)
        self._methods = self._table()
        self._server = RpcServer(address, self._dispatch, boundary)
        self.uri = f"http://{address}:{self._server.port}/"
        self._server.start()

    def close(self) -> None:
        """Stop serving."""
        self._server.close()

    def _table(self) -> dict[str, Method]:
        return self._graph_methods() | self._lookup_methods() | self._param_methods()

    def _graph_methods(self) -> dict[str, Method]:
        topic, kind, caller = ("topic", v.resource), ("topic_type", v.type_name), _CALLER_API
        service, service_api = ("service", v.resource), ("service_api", v.api)
        return {
            "registerPublisher": Method(self._register_publisher, [], (topic, kind, caller)),
            "registerSubscriber": Method(self._register_subscriber, [], (topic, kind, caller)),
            "unregisterPublisher": Method(self._unregister_publisher, 0, (topic, caller)),
            "unregisterSubscriber": Method(self._unregister_subscriber, 0, (topic, caller)),
            "registerService": Method(self._register_service, 0, (service, service_api, caller)),
            "unregisterService": Method(self._unregister_service, 0, (service, service_api)),
        }

    def _lookup_methods(self) -> dict[str, Method]:
        return {
            "lookupNode": Method(self._lookup_node, "", (("node", v.graph_name),)),
            "lookupService": Method(self._lookup_service, "", (("service", v.resource),)),
            "getSystemState": Method(self._system_state, [[], [], []]),
            "getTopicTypes": Method(self._topic_types, []),
            "getPublishedTopics": Method(self._published, [], (("subgraph", v.subgraph),)),
            "getUri": Method(lambda _: (1, "", self.uri), ""),
            "getPid": Method(lambda _: (1, "", os.getpid()), -1),
        }

    def _param_methods(self) -> dict[str, Method]:
        key = ("key", v.key)
        return {
            "getParam": Method(self._get_param, 0, (key,)),
            "setParam": Method(self._set_param, 0, (key, ("value", v.anything))),
            "hasParam": Method(lambda _, key: (1, key, self._params.has(key)), False, (key,)),
            "deleteParam": Method(self._delete_param, 0, (key,)),
            "searchParam": Method(self._search_param, "", (("key", v.search_key),)),
            "getParamNames": Method(lambda _: (1, "Parameter names", self._params.names()), []),
            "subscribeParam": Method(self._subscribe_param, {}, (_CALLER_API, key)),
            "unsubscribeParam": Method(self._unsubscribe_param, 0, (_CALLER_API, key)),
        }

    def _dispatch(self, name: str, params: tuple[Any, ...]) -> Triple:
        method = self._methods.get(name)
        if method is None:
            raise LookupError(f'method "{name}" is not supported')
        refusal = _refusal(method, params)
        if refusal:
            return -1, refusal, method.failure
        caller = str(params[0])
        try:
            checked = [
                check(label, value, caller)
                for (label, check), value in zip(method.checks, params[1:], strict=True)
            ]
            with self._lock:
                return method.run(caller, *checked)
        except v.Invalid as problem:
            return -1, str(problem), method.failure
        except TypeError as problem:
            return -1, f"Error: invalid arguments: {problem}", method.failure

    def _shut_down_replaced(self, caller: str, old_api: str | None) -> None:
        if old_api is not None:
            reason = f"[{caller}] Reason: new node registered with same name"
            self._notifier.post(old_api, "shutdown", "/master", reason)

    def _announce_publishers(self, topic: str) -> None:
        publishers = self._book.tables["publishers"].apis(topic)
        for api in self._book.tables["subscribers"].apis(topic):
            self._notifier.post(api, "publisherUpdate", "/master", topic, publishers)

    def _register_publisher(self, caller: str, topic: str, kind: str, api: str) -> Triple:
        self._shut_down_replaced(caller, self._book.register("publishers", topic, caller, api))
        self._book.set_type(topic, kind, by_publisher=True)
        self._announce_publishers(topic)
        subscribers = self._book.tables["subscribers"].apis(topic)
        return 1, f"Registered [{caller}] as publisher of [{topic}]", subscribers

    def _register_subscriber(self, caller: str, topic: str, kind: str, api: str) -> Triple:
        self._shut_down_replaced(caller, self._book.register("subscribers", topic, caller, api))
        self._book.set_type(topic, kind, by_publisher=False)
        return 1, f"Subscribed to [{topic}]", self._book.tables["publishers"].apis(topic)

    def _unregister_publisher(self, caller: str, topic: str, api: str) -> Triple:
        answer = self._book.unregister("publishers", topic, caller, api)
        if answer[2]:
            self._announce_publishers(topic)
        return answer

    def _unregister_subscriber(self, caller: str, topic: str, api: str) -> Triple:
        return self._book.unregister("subscribers", topic, caller, api)

    def _register_service(self, caller: str, service: str, service_api: str, api: str) -> Triple:
        replaced = self._book.register_service(service, caller, service_api, api)
        self._shut_down_replaced(caller, replaced)
        return 1, f"Registered [{caller}] as provider of [{service}]", 1

    def _unregister_service(self, caller: str, service: str, service_api: str) -> Triple:
        return self._book.unregister("services", service, caller, service_api)

    def _lookup_node(self, _caller: str, node: str) -> Triple:
        api = self._book.nodes.get(node)
        return (1, "node api", api) if api else (-1, f"unknown node [{node}]", "")

    def _lookup_service(self, _caller: str, service: str) -> Triple:
        apis = self._book.tables["services"].apis(service)
        return (1, f"rosrpc URI: [{apis[0]}]", apis[0]) if apis else (-1, "no provider", "")

    def _system_state(self, _caller: str) -> Triple:
        tables = ("publishers", "subscribers", "services")
        return 1, "current system state", [self._book.tables[name].state() for name in tables]

    def _topic_types(self, _caller: str) -> Triple:
        return 1, "current system state", [list(item) for item in self._book.types.items()]

    def _published(self, _caller: str, subgraph: str) -> Triple:
        return 1, "current topics", self._book.published(subgraph)

    def _get_param(self, _caller: str, key: str) -> Triple:
        if not self._params.has(key):
            return -1, f"Parameter [{key}] is not set", 0
        return 1, f"Parameter [{key}]", self._params.get(key)

    def _set_param(self, caller: str, key: str, value: Any) -> Triple:
        self._params.set(key, value)
        self._announce_param(key, value, but_not=caller)
        return 1, f"parameter {key} set", 0

    def _delete_param(self, _caller: str, key: str) -> Triple:
        try:
            self._params.delete(key)
        except KeyError:
            return -1, f"parameter [{key}] is not set", 0
        self._announce_param(key, UNSET, but_not=None)
        return 1, f"parameter {key} deleted", 0

    def _announce_param(self, key: str, value: Any, *, but_not: str | None) -> None:
        rows = self._book.tables["params"].rows
        for subscription, changed, news in updates(rows, key, value):
            for caller, api in rows[subscription]:
                if caller != but_not:
                    self._notifier.post(api, "paramUpdate", "/master", changed, news)

    def _search_param(self, caller: str, key: str) -> Triple:
        found = self._params.search(caller, key)
        if found is None:
            return -1, f"Cannot find parameter [{key}] in an upwards search", ""
        return 1, f"Found [{found}]", found

    def _subscribe_param(self, caller: str, api: str, key: str) -> Triple:
        replaced = self._book.register("params", subscription_key(key), caller, api)
        self._shut_down_replaced(caller, replaced)
        value = self._params.get(key) if self._params.has(key) else UNSET
        return 1, f"Subscribed to parameter [{key}]", value

    def _unsubscribe_param(self, caller: str, api: str, key: str) -> Triple:
        self._book.unregister("params", subscription_key(key), caller, api)
        return 1, f"Unsubscribe to parameter [{key}]", 1


_CALLER_API = ("caller_api", v.api)


def _refusal(method: Method, params: tuple[Any, ...]) -> str | None:
    """Say why a call is refused before its parameters are looked at, or None."""
    if not params:
        return "missing required caller_id parameter"
    if len(params) != len(method.checks) + 1:
        return "Error: bad call arity"
    if not isinstance(params[0], str):
        return "caller_id must be a string"
    return None
