"""A small ROS master with rosmaster's bookkeeping.

A node name has a single slave URI. If a node registers with another URI, the master removes the
former node's registrations and calls `shutdown` on the former node. A service has a single
provider, the last. An unregistration must have the registered string. Subscribers get every change
of a topic's publishers or of a parameter (rosmaster/master_api.py, registrations.py). Unlike
rosmaster, this master does not resolve names, and takes the key of a parameter as the whole name.

For tests, `answers` replaces the answer to a method, and `delay` delays all answers. `calls` and
`requests` have everything that came.
"""

from __future__ import annotations

import asyncio
import xmlrpc.client
from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any
from xmlrpc.client import Fault

from examples.demo.fake_http import Answer, FakeHttpServer, FakeRequest, authority, call, value

Triple = tuple[int, str, Any]
Provider = tuple[str, str]
"""caller_id, and the node's slave URI or (for a service) the service's URI."""

UNSET: dict[str, Any] = {}
"""The value that subscribers get for a parameter that is not set."""
ODD_PARAMETERS = (TypeError, AttributeError, LookupError, ValueError)
CALL_ERRORS = (OSError, EOFError, ValueError, xmlrpc.client.Error)
"""Errors of a call: the peer is gone, out of reach, or gives an invalid answer."""


class FakeMaster:
    """A ROS master; see the module.

    `nodes` has the slave URI of each node name. `tables` have the providers of each topic, service
    and parameter. Without `calls_back` the master reaches no node.
    """

    def __init__(self, address: str, port: int = 0) -> None:
        self.http = FakeHttpServer(self._respond)
        self.http.address = address, port
        self.pid = 4711
        self.answers: dict[str, Answer] = {}
        self.delay = 0.0
        self.calls_back = True
        self.requests: list[FakeRequest] = []
        self.calls: list[tuple[str, tuple[Any, ...]]] = []
        self._in_order: defaultdict[str, asyncio.Lock] = defaultdict(asyncio.Lock)
        self._callbacks: set[asyncio.Task[None]] = set()
        self._methods = self._table()
        self.forget()

    @property
    def uri(self) -> str:
        """The URI of the master."""
        return f"http://{authority(self.http.address)}"

    async def start(self, address: str = "") -> None:
        """Listen on the same port as before, and on the same address unless `address` is given."""
        await self.http.start(address or self.http.address[0], self.http.address[1])

    async def stop(self) -> None:
        """Stop listening and calling nodes."""
        for task in self._callbacks:
            task.cancel()
        await asyncio.gather(*self._callbacks, return_exceptions=True)
        await self.http.stop()

    async def restart(self) -> None:
        """Stop, and start like a new process without memory."""
        await self.stop()
        self.forget()
        self.pid += 1
        await self.start()

    def forget(self) -> None:
        """Lose all state."""
        kinds = ("publishers", "subscribers", "services", "params")
        self.nodes: dict[str, str] = {}
        self.tables: dict[str, dict[str, list[Provider]]] = {kind: {} for kind in kinds}
        self.types: dict[str, str] = {}
        self.params: dict[str, Any] = {}

    def holds(self, kind: str, name: str) -> list[str]:
        """The URIs registered for a topic, service or parameter, oldest first."""
        return [api for _, api in self.tables[kind].get(name, [])]

    def named(self, *methods: str) -> list[tuple[Any, ...]]:
        """The parameters of all calls of these methods."""
        return [params for method, params in self.calls if method in methods]

    def register(self, kind: str, key: str, caller: str, api: str) -> None:
        """Note a publisher, a subscriber, or a parameter subscription."""
        self._admit(caller, api)
        providers = self.tables[kind].setdefault(key, [])
        if (caller, api) not in providers:
            providers.append((caller, api))

    def _admit(self, caller: str, api: str) -> None:
        """Note a node's URI. The former node of this name loses all registrations."""
        former = self.nodes.get(caller, api)
        self.nodes[caller] = api
        if former != api:
            for kind, table in self.tables.items():
                for key, providers in [*table.items()]:
                    self._keep(kind, key, [p for p in providers if p[0] != caller])
            reason = f"[{caller}] Reason: new node registered with same name"
            self._notify(former, "shutdown", reason)

    def _keep(self, kind: str, key: str, providers: list[Provider]) -> None:
        if providers:
            self.tables[kind][key] = providers
        else:
            del self.tables[kind][key]

    # Calling nodes back

    def _notify(self, uri: object, method: str, *params: Any) -> None:
        """Call a node in the background: one call at a time, in order.

        No call if ``uri`` is no string: a real master has refused such a URI before.
        """
        if isinstance(uri, str) and self.calls_back:
            task = asyncio.ensure_future(self._call_back(uri, method, params))
            self._callbacks.add(task)
            task.add_done_callback(self._callbacks.discard)

    async def _call_back(self, uri: str, method: str, params: tuple[Any, ...]) -> None:
        async with self._in_order[uri]:
            with suppress(*CALL_ERRORS):
                await call(uri, method, "/master", *params, source=self.http.address[0])

    def _announce_publishers(self, topic: str) -> None:
        for uri in self.holds("subscribers", topic):
            self._notify(uri, "publisherUpdate", topic, self.holds("publishers", topic))

    def _announce_param(self, key: str, value: Any, but_not: str = "") -> None:
        for caller, uri in self.tables["params"].get(key, []):
            if caller != but_not:
                self._notify(uri, "paramUpdate", key, value)

    # Answering

    async def _respond(self, request: FakeRequest) -> Answer:
        self.requests.append(request)
        await asyncio.sleep(self.delay)
        method, params = request.call
        if method in self.answers:
            return self.answers[method]
        try:
            if method == "system.multicall":
                return value([self._element(item) for item in params[0]])
            return value(self._run(method, params))
        except ODD_PARAMETERS as error:
            return value(Fault(1, repr(error)))

    def _element(self, item: dict[str, Any]) -> Any:
        result = self._run(item["methodName"], tuple(item["params"]))
        return vars(result) if isinstance(result, Fault) else [result]

    def _run(self, method: str, params: tuple[Any, ...]) -> Triple | Fault:
        self.calls.append((method, params))
        if method not in self._methods:
            return Fault(1, f'method "{method}" is not supported')
        try:
            return self._methods[method](*params)
        except ODD_PARAMETERS as error:
            return -1, repr(error), 0

    def _table(self) -> dict[str, Callable[..., Triple]]:
        return {
            "registerPublisher": self._register_publisher,
            "registerSubscriber": self._register_subscriber,
            "registerService": self._register_service,
            "subscribeParam": self._subscribe_param,
            "unregisterPublisher": partial(self._unregister, "publishers"),
            "unregisterSubscriber": partial(self._unregister, "subscribers"),
            "unregisterService": partial(self._unregister, "services"),
            "unsubscribeParam": lambda caller, api, key: self._unregister(
                "params", caller, key, api
            ),
            "lookupNode": self._look_up_node,
            "lookupService": self._look_up_service,
            "getSystemState": self._system_state,
            "getTopicTypes": lambda _: (1, "topic types", [[*item] for item in self.types.items()]),
            "getPid": lambda _: (1, "", self.pid),
            "getUri": lambda _: (1, self.uri, f"{self.uri}/"),
            "setParam": self._set_param,
            "getParam": self._get_param,
            "deleteParam": self._delete_param,
            "hasParam": lambda _, key: (1, key, key in self.params),
            "getParamNames": lambda _: (1, "parameter names", sorted(self.params)),
        }

    def _register_publisher(self, caller: str, topic: str, kind: str, api: str) -> Triple:
        self.register("publishers", topic, caller, api)
        if kind != "*" or topic not in self.types:  # a publisher decides on the type
            self.types[topic] = kind
        self._announce_publishers(topic)
        said = f"Registered [{caller}] as publisher of [{topic}]"
        return 1, said, self.holds("subscribers", topic)

    def _register_subscriber(self, caller: str, topic: str, kind: str, api: str) -> Triple:
        self.register("subscribers", topic, caller, api)
        if kind != "*":
            self.types.setdefault(topic, kind)
        return 1, f"Subscribed to [{topic}]", self.holds("publishers", topic)

    def _register_service(self, caller: str, service: str, service_api: str, api: str) -> Triple:
        self._admit(caller, api)
        self.tables["services"][service] = [(caller, service_api)]
        return 1, f"Registered [{caller}] as provider of [{service}]", 1

    def _subscribe_param(self, caller: str, api: str, key: str) -> Triple:
        self.register("params", key, caller, api)
        return 1, f"Subscribed to parameter [{key}]", self.params.get(key, UNSET)

    def _unregister(self, kind: str, caller: str, key: str, api: str) -> Triple:
        providers = self.tables[kind].get(key, [])
        if caller not in self.nodes:
            return 1, f"[{caller}] is not a registered node", 0
        if (caller, api) not in providers:
            return 1, f"[{caller}] is not a known provider of [{key}]", 0
        self._keep(kind, key, [p for p in providers if p != (caller, api)])
        left = [row for table in self.tables.values() for row in table.values()]
        if not any(provider[0] == caller for row in left for provider in row):
            del self.nodes[caller]
        if kind == "publishers":
            self._announce_publishers(key)
        return 1, f"Unregistered [{caller}] as provider of [{key}]", 1

    def _look_up_node(self, _caller: str, node: str) -> Triple:
        uri = self.nodes.get(node)
        return (1, "node api", uri) if uri else (-1, f"unknown node [{node}]", "")

    def _look_up_service(self, _caller: str, service: str) -> Triple:
        uris = self.holds("services", service)
        return (1, f"rosrpc URI: [{uris[0]}]", uris[0]) if uris else (-1, "no provider", "")

    def _system_state(self, _caller: str) -> Triple:
        tables = [self.tables[kind] for kind in ("publishers", "subscribers", "services")]
        state = [
            [[key, [name for name, _ in row]] for key, row in table.items()] for table in tables
        ]
        return 1, "current system state", state

    def _set_param(self, caller: str, key: str, value: Any) -> Triple:
        self.params[key] = value
        self._announce_param(key, value, but_not=caller)
        return 1, f"parameter {key} set", 0

    def _get_param(self, _caller: str, key: str) -> Triple:
        within = f"{key.rstrip('/')}/"
        names = {n.removeprefix(within): n for n in self.params if n.startswith(within)}
        if names:
            return 1, key, {name: self.params[full] for name, full in names.items()}
        return (1, key, self.params[key]) if key in self.params else (-1, "not set", 0)

    def _delete_param(self, _caller: str, key: str) -> Triple:
        if key not in self.params:
            return -1, f"parameter [{key}] is not set", 0
        del self.params[key]
        self._announce_param(key, UNSET)
        return 1, f"parameter {key} deleted", 0
