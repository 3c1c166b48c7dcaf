"""One process of the demo: a node or the master, run by its parent through JSON lines.

`python -m rosproxy.demo.worker CONFIG` takes its set-up as one JSON argument. It reads commands
from standard input and writes reports and answers to standard output, one JSON object a line.
It ends by itself when standard input does: nothing outlives the demo.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

from rosproxy.demo import service, wire
from rosproxy.demo.boundary import Boundary
from rosproxy.demo.master import Master
from rosproxy.demo.node import Node
from rosproxy.demo.rpc import CALL_ERRORS, RosError, ask

REPORT_SECONDS = 0.1
FAILURES = (*CALL_ERRORS, RosError, wire.ProtocolError)


def emit(message: dict[str, Any]) -> None:
    """Write one line to the parent in one piece; a parent that is gone needs none."""
    try:
        os.write(1, json.dumps(message).encode() + b"\n")
    except BrokenPipeError:
        return


def obey(act: Callable[[dict[str, Any]], dict[str, Any]], stop: threading.Event) -> None:
    """Carry out commands until standard input ends, then set `stop`."""
    # Unbuffered: a buffer's lock, held by this thread, would disturb the interpreter's end.
    with open(0, "rb", buffering=0, closefd=False) as lines:
        for line in lines:
            command = json.loads(line)
            emit({"id": command["id"], **act(command)})
    stop.set()


def start_obeying(act: Callable[[dict[str, Any]], dict[str, Any]], stop: threading.Event) -> None:
    """Run `obey` in the background."""
    threading.Thread(target=obey, args=(act, stop), daemon=True).start()


class NodeWorker:
    """A node with at most one of each: publisher, subscription, service."""

    def __init__(self, config: dict[str, Any]) -> None:
        boundary = Boundary.from_json(config["boundary"])
        boundary.raise_wall()
        place = (config["address"], config["host"])
        self._node = Node(config["name"], config["master"], *place, boundary)
        self._publisher = self._node.advertise(config["publish"]) if config["publish"] else None
        topic, offered = config["subscribe"], config["serve"]
        self._subscription = self._node.subscribe(topic) if topic else None
        self._service = self._node.serve(offered) if offered else None
        self._period = 1.0 / config["rate"]
        self._paused = threading.Event()

    def run(self) -> None:
        """Publish and report until the parent or the master says to stop."""
        self._node.start()
        start_obeying(self._act, self._node.stopping)
        next_message = next_report = time.monotonic()
        while not self._node.stopping.wait(max(0.0, next_message - time.monotonic())):
            self._publish()
            next_message += self._period
            if next_report <= time.monotonic():
                emit({"state": self._state()})
                next_report += REPORT_SECONDS
        self._node.close()

    def _publish(self) -> None:
        if self._publisher and self._node.registered.is_set() and not self._paused.is_set():
            self._publisher.publish()

    def _state(self) -> dict[str, Any]:
        return {
            "uri": self._node.uri,
            "registered": self._node.registered.is_set(),
            "publisher": self._publisher.to_json() if self._publisher else None,
            "subscription": self._subscription.to_json() if self._subscription else None,
            "answered": self._service.answered if self._service else None,
        }

    def _act(self, command: dict[str, Any]) -> dict[str, Any]:
        actions: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
            "call": self._call,
            "identify": self._identify,
            "reach": self._reach,
            "pause": self._pause,
            "report": lambda _: {"state": self._state()},
        }
        try:
            return actions[command["do"]](command)
        except FAILURES as problem:
            return {"error": str(problem) or type(problem).__name__}

    def _call(self, command: dict[str, Any]) -> dict[str, Any]:
        node, a, b = self._node, command["a"], command["b"]
        total = service.add(node.boundary, node.master, node.name, command["service"], a, b)
        return {"sum": total, "time": time.monotonic()}

    def _identify(self, command: dict[str, Any]) -> dict[str, Any]:
        """Ask the master for each node's address, and that address for its process id."""
        return {"nodes": {name: self._look_up(name) for name in command["names"]}}

    def _look_up(self, name: str) -> dict[str, Any]:
        node = self._node
        uri = ask(node.boundary, node.master, "lookupNode", node.name, name)
        try:
            return {"uri": uri, "pid": ask(node.boundary, uri, "getPid", node.name)}
        except FAILURES as problem:
            return {"uri": uri, "pid": None, "error": str(problem)}

    def _reach(self, command: dict[str, Any]) -> dict[str, Any]:
        """Try a plain connection."""
        self._node.boundary.connect(command["host"], command["port"], 1.0).close()
        return {"reached": True}

    def _pause(self, _command: dict[str, Any]) -> dict[str, Any]:
        self._paused.set()
        return {}


def run_master(config: dict[str, Any]) -> None:
    """Serve as the master until standard input ends."""
    boundary = Boundary.from_json(config["boundary"])
    boundary.raise_wall()
    master = Master(config["address"], boundary)
    stop = threading.Event()
    start_obeying(lambda _: {}, stop)
    emit({"state": {"uri": master.uri}})
    stop.wait()
    master.close()


def main() -> None:
    """Run what the JSON argument describes."""
    config = json.loads(sys.argv[1])
    if config["role"] == "master":
        run_master(config)
    else:
        NodeWorker(config).run()


if __name__ == "__main__":
    main()
