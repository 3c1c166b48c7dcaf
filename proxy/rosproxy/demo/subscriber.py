"""A subscriber, and how it comes back to a publisher that it lost.

Real ROS subscribers differ in that. roscpp tries the same address again, after 0.1 s and then
twice as long each time. rospy gives up a connection that ended, and connects anew, beginning
with requestTopic, when the master's next publisherUpdate still names the publisher. The subscriber
here does both: it retries like roscpp, and an update makes it start over at once like rospy.
"""

from __future__ import annotations

import socket
import threading
import time
from typing import Any

from rosproxy.demo import wire
from rosproxy.demo.boundary import Boundary
from rosproxy.demo.records import Link, Received
from rosproxy.demo.rpc import CALL_ERRORS, RosError, ask, end_connection

FIRST_RETRY = 0.1
MAX_RETRY = 20.0
CONNECT_TIMEOUT = 3.0


class Subscription:
    """One topic of one node: a worker for every publisher that the master names."""

    def __init__(self, caller_id: str, topic: str, boundary: Boundary) -> None:
        self.topic = topic
        self.kind = wire.STRING
        self.caller_id = caller_id
        self.boundary = boundary
        self.received = Received()
        self.problem = ""
        self._links: list[Link] = []
        self._workers: dict[str, _Worker] = {}
        self._updated = False
        self._lock = threading.Lock()

    def begin(self, publishers: list[str]) -> None:
        """Take the list that came with the registration's reply.

        An update that overtook the reply is newer: the master sends them to registered nodes only.
        """
        with self._lock:
            if self._updated:
                return
            self._follow_only(publishers)

    def update(self, publishers: list[str]) -> None:
        """Follow the master's list of publishers (their slave URIs)."""
        with self._lock:
            self._updated = True
            gone = self._follow_only(publishers)
        for worker in gone:
            worker.stop()

    def _follow_only(self, publishers: list[str]) -> list[_Worker]:
        """Have a worker for each publisher; return the workers of those that are gone."""
        for uri in publishers:
            worker = self._workers.get(uri)
            if worker is None or not worker.prod():
                self._workers[uri] = _Worker(self, uri)
        return [self._workers.pop(uri) for uri in [*self._workers] if uri not in publishers]

    def close(self) -> None:
        """Drop all publishers and wait for the workers to end."""
        with self._lock:
            workers = list(self._workers.values())
        self.update([])
        for worker in workers:
            worker.join()

    def opened(self, link: Link) -> None:
        """Note that a publisher was reached."""
        with self._lock:
            self._links.append(link)
            self.problem = ""

    def closed(self, link: Link) -> None:
        """Note that a connection ended."""
        with self._lock:
            link.closed = time.monotonic()

    def failed(self, problem: str) -> None:
        """Note why a publisher couldn't be reached."""
        with self._lock:
            self.problem = problem

    def take(self, link: Link, body: bytes) -> None:
        """Count a message; raises ProtocolError when it is none of ours."""
        number = wire.unpack_string(body).rpartition(" ")[2]
        if not number.isdecimal():
            raise wire.ProtocolError("a message without a number")
        with self._lock:
            link.first_message = link.first_message or time.monotonic()
            self.received.note(int(number))

    def connected_to(self) -> list[str]:
        """Return the URIs of the publishers that are connected."""
        with self._lock:
            return [link.uri for link in self._links if link.closed is None]

    def to_json(self) -> dict[str, Any]:
        """Return everything the summary wants to know, as plain data."""
        with self._lock:
            return {
                "topic": self.topic,
                "connected": sum(link.closed is None for link in self._links),
                "links": [link.to_json() for link in self._links],
                "problem": self.problem,
                **self.received.to_json(),
            }


class _Worker:
    """Keeps one subscription connected to one publisher, in a thread of its own."""

    def __init__(self, owner: Subscription, uri: str) -> None:
        self._owner = owner
        self._uri = uri
        self._lock = threading.Lock()
        self._named = threading.Event()
        self._named.set()
        self._address: tuple[str, int] | None = None
        self._connection: socket.socket | None = None
        self._stopped = False
        self._gave_up = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def prod(self) -> bool:
        """Hear that the master names the publisher again; False if this worker has given up."""
        with self._lock:
            self._named.set()
            return not self._gave_up

    def stop(self) -> None:
        """End the connection, and soon the thread."""
        with self._lock:
            self._stopped = True
            self._named.set()
            if self._connection is not None:
                end_connection(self._connection)

    def join(self) -> None:
        """Wait for the thread after `stop`."""
        self._thread.join()

    def _run(self) -> None:
        while self._wanted():
            try:
                self._request_topic()
            except (*CALL_ERRORS, RosError, wire.ProtocolError) as problem:
                self._owner.failed(str(problem) or type(problem).__name__)
            try:
                self._keep_connected()
            except wire.ProtocolError as problem:
                self._owner.failed(str(problem))

    def _wanted(self) -> bool:
        """Decide whether to begin anew: only if the master has named the publisher since."""
        with self._lock:
            wanted = self._named.is_set() and not self._stopped
            self._named.clear()
            self._gave_up = not wanted
            return wanted

    def _request_topic(self) -> None:
        """Ask the publisher where to connect to; raises RosError or one of CALL_ERRORS."""
        owner = self._owner
        args = (owner.caller_id, owner.topic, [["TCPROS"]])
        answer = ask(owner.boundary, self._uri, "requestTopic", *args)
        if not isinstance(answer, list) or len(answer) != 3 or answer[0] != "TCPROS":
            raise RosError(f"requestTopic: unusable answer {answer!r}")
        self._address = (str(answer[1]), int(answer[2]))

    def _keep_connected(self) -> None:
        """Connect, again and again, until the master names the publisher anew or `stop`.

        Raises ProtocolError when the publisher refuses the connection: no use trying again.
        """
        pause = FIRST_RETRY
        while self._address is not None and not self._stopped:
            if self._follow(*self._address):
                pause = FIRST_RETRY
            if self._named.wait(pause):
                return
            pause = min(pause * 2, MAX_RETRY)

    def _follow(self, host: str, port: int) -> bool:
        """Connect once and read until the connection ends; return whether it was made."""
        try:
            connection = self._owner.boundary.connect(host, port, CONNECT_TIMEOUT)
        except OSError as problem:
            self._owner.failed(str(problem))
            return False
        with connection:
            link = Link(self._uri, f"{host}:{port}", time.monotonic())
            try:
                self._hold(connection)
                self._shake_hands(connection)
                self._owner.opened(link)
                self._read(connection, link)
            except OSError as problem:
                self._owner.failed(str(problem))
            finally:
                self._owner.closed(link)
                self._release()
        return True

    def _shake_hands(self, connection: socket.socket) -> None:
        kind = self._owner.kind
        names = {"callerid": self._owner.caller_id, "topic": self._owner.topic}
        extras = {"tcp_nodelay": "1", "message_definition": kind.definition}
        wire.send_header(connection, kind.fields() | names | extras)
        if not kind.accepts(wire.receive_header(connection)):
            raise wire.ProtocolError(f"topic types do not match on [{self._owner.topic}]")
        connection.settimeout(None)

    def _read(self, connection: socket.socket, link: Link) -> None:
        while True:
            self._owner.take(link, wire.receive_block(connection))

    def _hold(self, connection: socket.socket) -> None:
        with self._lock:
            self._connection = connection
            if self._stopped:
                end_connection(connection)

    def _release(self) -> None:
        """Forget the connection, and what the master said while it lasted: that was no news."""
        with self._lock:
            self._connection = None
            if not self._stopped:
                self._named.clear()
