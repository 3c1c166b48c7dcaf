"""A small ROS node: slave API, TCPROS server, topics and services, registered at a master."""

from __future__ import annotations

import socket
import threading
from typing import Any

from rosproxy.demo import wire
from rosproxy.demo.boundary import Boundary
from rosproxy.demo.publisher import Publisher
from rosproxy.demo.rpc import CALL_ERRORS, RosError, RpcServer, ask, call
from rosproxy.demo.service import Service
from rosproxy.demo.slave import SlaveApi
from rosproxy.demo.subscriber import Subscription
from rosproxy.demo.tcp import TcprosServer

RETRY_SECONDS = 0.1
"""Pause between attempts to register while the master doesn't answer."""


class Node:
    """A node that lives at `address` and calls itself `host`; `close` unregisters and stops it."""

    def __init__(self, name: str, master: str, address: str, host: str, boundary: Boundary) -> None:
        self.name = name
        self.master = master
        self.host = host
        self.boundary = boundary
        self.registered = threading.Event()
        self.stopping = threading.Event()
        self.publishers: dict[str, Publisher] = {}
        self.subscriptions: dict[str, Subscription] = {}
        self.services: dict[str, Service] = {}
        self._tcpros = TcprosServer(address, self._serve, boundary)
        self._rpc = RpcServer(address, SlaveApi(self, self._tcpros.port).dispatch, boundary)
        self.uri = f"http://{host}:{self._rpc.port}/"
        self._service_uri = f"rosrpc://{host}:{self._tcpros.port}"
        self._registrar = threading.Thread(target=self._register, daemon=True)
        self.advertise("/rosout", wire.LOG)

    def advertise(self, topic: str, kind: wire.RosType = wire.STRING) -> Publisher:
        """Offer a topic; to be called before `start`."""
        publisher = Publisher(self.name, topic, kind)
        self.publishers[topic] = publisher
        return publisher

    def subscribe(self, topic: str) -> Subscription:
        """Subscribe to a topic; to be called before `start`."""
        subscription = Subscription(self.name, topic, self.boundary)
        self.subscriptions[topic] = subscription
        return subscription

    def serve(self, name: str) -> Service:
        """Offer a service that adds two integers; to be called before `start`."""
        service = Service(self.name, name)
        self.services[name] = service
        return service

    def start(self) -> None:
        """Serve, and register at the master as soon as it answers."""
        self._rpc.start()
        self._tcpros.start()
        self._registrar.start()

    def close(self) -> None:
        """Unregister, drop all connections, stop."""
        self.stopping.set()
        self._registrar.join()
        self._unregister()
        for subscription in self.subscriptions.values():
            subscription.close()
        self._tcpros.close()
        self._rpc.close()

    def _register(self) -> None:
        for method, *args in self._registrations():
            answer = self._insist(method, *args)
            if method == "registerSubscriber" and answer is not None:
                self.subscriptions[args[0]].begin([str(uri) for uri in answer])
        if not self.stopping.is_set():
            self.registered.set()

    def _registrations(self) -> list[tuple[str, ...]]:
        return [
            *(
                ("registerPublisher", topic, publisher.kind.name, self.uri)
                for topic, publisher in self.publishers.items()
            ),
            *(
                ("registerSubscriber", topic, subscription.kind.name, self.uri)
                for topic, subscription in self.subscriptions.items()
            ),
            *(("registerService", name, self._service_uri, self.uri) for name in self.services),
        ]

    def _insist(self, method: str, *args: str) -> Any:
        """Call the master until it answers, as every ROS node does; None if stopped before."""
        while not self.stopping.is_set():
            try:
                return ask(self.boundary, self.master, method, self.name, *args)
            except (*CALL_ERRORS, RosError):
                self.stopping.wait(RETRY_SECONDS)
        return None

    def _unregister(self) -> None:
        """Take back all registrations in one call, as rospy does when it shuts down."""
        undo = {
            "registerPublisher": ("unregisterPublisher", 1, 3),
            "registerSubscriber": ("unregisterSubscriber", 1, 3),
            "registerService": ("unregisterService", 1, 2),
        }
        calls = []
        for registration in self._registrations():
            method, key, api = undo[registration[0]]
            params = [self.name, registration[key], registration[api]]
            calls.append({"methodName": method, "params": params})
        try:
            call(self.boundary, self.master, "system.multicall", calls)
        except CALL_ERRORS:
            # The master is gone; nobody will look for this node there.
            return

    def _serve(self, connection: socket.socket, header: dict[str, str]) -> None:
        """Route a TCPROS connection by its header; raises ProtocolError, OSError."""
        target: Publisher | Service | None = None
        if "topic" in header:
            target = self.publishers.get(header["topic"])
        elif "service" in header:
            target = self.services.get(header["service"])
        if target is None:
            raise wire.ProtocolError(f"[{self.name}] offers no such topic or service")
        target.serve(connection, header)
