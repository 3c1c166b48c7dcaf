"""The real master of a test: small, with ROS's own bookkeeping, and with knobs."""

import asyncio
import re
import xmlrpc.client
from collections import deque
from contextlib import suppress
from typing import Any
from xmlrpc.client import Fault

from rosproxy.demo.book import Book
from tests.integration.http_fake import Answer, HttpFake, Request, ok, value
from tests.integration.net import MASTER, bracketed, rpc, where

Triple = list[Any]
NEW_NODE = "Reason: new node registered with same name"
ODD_PARAMETERS = (TypeError, AttributeError, LookupError, ValueError)


class Master:
    """A ROS master.

    ``answers`` replaces the answer to a method by raw bytes or an End; ``calls`` are all calls
    that came, the elements of a system.multicall one by one; ``bodies`` and ``requests`` are what
    came on the wire.
    """

    def __init__(self) -> None:
        self._http = HttpFake(self._respond)
        self._told: deque[tuple[str, str, tuple[Any, ...]]] = deque()
        self._telling: asyncio.Task[None] | None = None
        self.pid = 4711
        self.answers: dict[str, Answer] = {}
        self.delay = 0.0
        self.requests: list[Request] = []
        self.calls: list[tuple[str, tuple[Any, ...]]] = []
        self.forget()

    @property
    def uri(self) -> str:
        """Its URI."""
        host, port = self._http.address
        return f"http://{bracketed(host)}:{port}"

    async def start(self, address: str = MASTER) -> None:
        """Listen; on the same port as before if there was one."""
        await self._http.start(address, self._http.address[1])
        self._telling = asyncio.create_task(self._tell())

    async def stop(self) -> None:
        """Go down."""
        if self._telling:
            self._telling.cancel()
            await asyncio.gather(self._telling, return_exceptions=True)
        await self._http.stop()

    def forget(self) -> None:
        """Lose all state, as a master does that is started anew."""
        self.book = Book()
        self.params: dict[str, Any] = {}

    async def restart(self) -> None:
        """Die and come back as a new process without memory."""
        await self.stop()
        self.forget()
        self.pid += 1
        await self.start()

    def named(self, *methods: str) -> list[tuple[Any, ...]]:
        """The parameters of all calls of these methods."""
        return [params for method, params in self.calls if method in methods]

    def holds(self, kind: str, name: str) -> list[str]:
        """The URIs registered for a topic, service or parameter."""
        return self.book.tables[kind].apis(name)

    async def _respond(self, request: Request) -> Answer:
        self.requests.append(request)
        await asyncio.sleep(self.delay)
        method, params = request.call
        if method in self.answers:
            return self.answers[method]
        try:
            if method == "system.multicall":
                return value([self._element(item) for item in params[0]])
            self.calls.append((method, params))
            return value(self._run(method, params))
        except Fault as fault:
            return ok(xmlrpc.client.dumps(fault, methodresponse=True).encode())
        except ODD_PARAMETERS as error:
            return ok(xmlrpc.client.dumps(Fault(1, repr(error)), methodresponse=True).encode())

    def _element(self, item: dict[str, Any]) -> Any:
        method, params = item["methodName"], tuple(item["params"])
        self.calls.append((method, params))
        try:
            return [self._run(method, params)]
        except Fault as fault:
            return {"faultCode": fault.faultCode, "faultString": fault.faultString}

    def _run(self, method: str, params: tuple[Any, ...]) -> Triple:
        run = getattr(self, f"_do_{_snake_case(method)}", None)
        if run is None:
            raise Fault(1, f'method "{method}" is not supported')
        try:
            result: Triple = run(*params)
        except ODD_PARAMETERS as error:
            return [-1, repr(error), 0]
        return result

    def _replace(self, caller: str, old: str | None) -> None:
        if old:
            self._told.append((old, "shutdown", (f"[{caller}] {NEW_NODE}",)))

    def _announce(self, topic: str) -> None:
        publishers = self.holds("publishers", topic)
        for uri in self.holds("subscribers", topic):
            self._told.append((uri, "publisherUpdate", (topic, publishers)))

    async def _tell(self) -> None:
        while True:
            while self._told:
                uri, method, params = self._told.popleft()
                if where(uri)[0] == "robot":  # no name server here knows it
                    continue
                with suppress(OSError, EOFError, TimeoutError, xmlrpc.client.Error):
                    await rpc(uri, method, "/master", *params, source=MASTER)
            await asyncio.sleep(0.005)

    def _do_register_publisher(self, caller: str, topic: str, type_: str, api: str) -> Triple:
        self._replace(caller, self.book.register("publishers", topic, caller, api))
        self.book.set_type(topic, type_, by_publisher=True)
        self._announce(topic)
        return [1, "registered", self.holds("subscribers", topic)]

    def _do_register_subscriber(self, caller: str, topic: str, type_: str, api: str) -> Triple:
        self._replace(caller, self.book.register("subscribers", topic, caller, api))
        self.book.set_type(topic, type_, by_publisher=False)
        return [1, "subscribed", self.holds("publishers", topic)]

    def _do_register_service(self, caller: str, service: str, service_api: str, api: str) -> Triple:
        self._replace(caller, self.book.register_service(service, caller, service_api, api))
        return [1, "registered", 1]

    def _do_unregister_publisher(self, caller: str, topic: str, api: str) -> Triple:
        result = self.book.unregister("publishers", topic, caller, api)
        if result[2]:
            self._announce(topic)
        return list(result)

    def _do_unregister_subscriber(self, caller: str, topic: str, api: str) -> Triple:
        return list(self.book.unregister("subscribers", topic, caller, api))

    def _do_unregister_service(self, caller: str, service: str, service_api: str) -> Triple:
        return list(self.book.unregister("services", service, caller, service_api))

    def _do_subscribe_param(self, caller: str, api: str, key: str) -> Triple:
        self._replace(caller, self.book.register("params", key, caller, api))
        return [1, "subscribed", self.params.get(key, {})]

    def _do_unsubscribe_param(self, caller: str, api: str, key: str) -> Triple:
        return list(self.book.unregister("params", key, caller, api))

    def _do_lookup_node(self, _caller: str, node: str) -> Triple:
        uri = self.book.nodes.get(node)
        return [1, "node api", uri] if uri else [-1, f"unknown node [{node}]", ""]

    def _do_lookup_service(self, _caller: str, service: str) -> Triple:
        found = self.holds("services", service)
        return [1, f"rosrpc URI: [{found[0]}]", found[0]] if found else [-1, "no provider", ""]

    def _do_get_system_state(self, _caller: str) -> Triple:
        kinds = ("publishers", "subscribers", "services")
        return [1, "current system state", [self.book.tables[kind].state() for kind in kinds]]

    def _do_get_topic_types(self, _caller: str) -> Triple:
        return [1, "current system state", [list(item) for item in self.book.types.items()]]

    def _do_get_pid(self, _caller: str) -> Triple:
        return [1, "", self.pid]

    def _do_get_uri(self, _caller: str) -> Triple:
        return [1, self.uri, f"{self.uri}/"]

    def _do_set_param(self, _caller: str, key: str, held: Any) -> Triple:
        self.params[key] = held
        return [1, f"parameter {key} set", 0]

    def _do_get_param(self, _caller: str, key: str) -> Triple:
        return [1, key, self.params[key]] if key in self.params else [-1, "not set", 0]

    def _do_get_param_names(self, _caller: str) -> Triple:
        return [1, "parameter names", sorted(self.params)]


def _snake_case(name: str) -> str:
    return re.sub("([A-Z])", r"_\1", name).lower()
