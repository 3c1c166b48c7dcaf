"""The slave API of a small ROS node: what the master and other nodes may ask it."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Mapping
from typing import Any, Protocol

from rosproxy.demo.publisher import Publisher
from rosproxy.demo.subscriber import Subscription

Triple = tuple[int, str, Any]


class Host(Protocol):
    """What the slave API needs of its node."""

    master: str
    host: str
    stopping: threading.Event
    publishers: dict[str, Publisher]
    subscriptions: dict[str, Subscription]


class SlaveApi:
    """Answers slave API calls for a node whose TCPROS server listens on `port`."""

    def __init__(self, node: Host, port: int) -> None:
        self._node = node
        self._port = port
        self._methods: Mapping[str, Callable[..., Triple]] = {
            "getPid": self._get_pid,
            "getMasterUri": self._get_master_uri,
            "getPublications": self._get_publications,
            "getSubscriptions": self._get_subscriptions,
            "getBusInfo": self._get_bus_info,
            "publisherUpdate": self._publisher_update,
            "paramUpdate": self._param_update,
            "requestTopic": self._request_topic,
            "shutdown": self._shutdown,
        }

    def dispatch(self, method: str, params: tuple[Any, ...]) -> Triple:
        """Answer one call; raises LookupError for a method that there is none of."""
        if method not in self._methods:
            raise LookupError(f'method "{method}" is not supported')
        try:
            return self._methods[method](*params)
        except TypeError as problem:
            return -1, f"Error: invalid arguments: {problem}", 0

    def _get_pid(self, _caller: str) -> Triple:
        return 1, "", os.getpid()

    def _get_master_uri(self, _caller: str) -> Triple:
        return 1, self._node.master, self._node.master

    def _get_publications(self, _caller: str) -> Triple:
        publishers = self._node.publishers.values()
        return 1, "publications", [[item.topic, item.kind.name] for item in publishers]

    def _get_subscriptions(self, _caller: str) -> Triple:
        subscriptions = self._node.subscriptions.values()
        return 1, "subscriptions", [[item.topic, item.kind.name] for item in subscriptions]

    def _get_bus_info(self, _caller: str) -> Triple:
        rows: list[list[Any]] = []
        for publisher in self._node.publishers.values():
            rows += [[peer, "o", "TCPROS", publisher.topic, True] for peer in publisher.peers()]
        for subscription in self._node.subscriptions.values():
            uris = subscription.connected_to()
            rows += [[uri, "i", "TCPROS", subscription.topic, True] for uri in uris]
        return 1, "bus info", [[number, *row] for number, row in enumerate(rows)]

    def _publisher_update(self, _caller: str, topic: str, publishers: list[str]) -> Triple:
        subscription = self._node.subscriptions.get(topic)
        if subscription is not None and not self._node.stopping.is_set():
            subscription.update([str(uri) for uri in publishers])
        return 1, "", 0

    def _param_update(self, _caller: str, _key: str, _value: Any) -> Triple:
        return -1, "not subscribed", 0

    def _request_topic(self, _caller: str, topic: str, protocols: list[list[Any]]) -> Triple:
        if topic not in self._node.publishers:
            return -1, f"Not a publisher of [{topic}]", []
        if not any(offer and offer[0] == "TCPROS" for offer in protocols):
            return 0, "no supported protocol implementations", []
        host, port = self._node.host, self._port
        return 1, f"ready on {host}:{port}", ["TCPROS", host, port]

    def _shutdown(self, _caller: str, _reason: str = "") -> Triple:
        self._node.stopping.set()
        return 1, "shutdown", 0
