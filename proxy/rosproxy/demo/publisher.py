"""A publisher: keeps the connections of its subscribers and writes each message to all of them."""

from __future__ import annotations

import socket
import threading
import time
from typing import Any

from rosproxy.demo import wire
from rosproxy.demo.records import Session
from rosproxy.demo.rpc import end_connection

SEND_TIMEOUT = 1.0
"""Seconds a subscriber may stall before its connection is given up."""


class Publisher:
    """One topic of one node; TCPROS connections arrive through `serve`."""

    def __init__(self, caller_id: str, topic: str, kind: wire.RosType) -> None:
        self.topic = topic
        self.kind = kind
        self.published = 0
        self.unheard = 0
        self._caller_id = caller_id
        self._lock = threading.Lock()
        self._sessions: list[Session] = []
        self._open: dict[socket.socket, Session] = {}

    def serve(self, connection: socket.socket, header: dict[str, str]) -> None:
        """Serve one subscriber until it goes; raises ProtocolError when the types don't match."""
        if not self.kind.accepts(header):
            raise wire.ProtocolError(f"topic types do not match on [{self.topic}]")
        self._admit(connection, header.get("callerid", "?"))
        try:
            _wait_for_end(connection)
        finally:
            self._dismiss(connection)

    def _admit(self, connection: socket.socket, peer: str) -> None:
        connection.settimeout(SEND_TIMEOUT)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        # Under the lock, so that no message overtakes the header and none of those
        # that follow it is missing from the session.
        with self._lock:
            wire.send_header(connection, self._reply())
            session = Session(peer, time.monotonic())
            self._open[connection] = session
            self._sessions.append(session)

    def _reply(self) -> dict[str, str]:
        return self.kind.fields() | {
            "callerid": self._caller_id,
            "latching": "0",
            "message_definition": self.kind.definition,
            "topic": self.topic,
        }

    def _dismiss(self, connection: socket.socket) -> None:
        with self._lock:
            session = self._open.pop(connection, None)
            if session is not None:
                session.closed = time.monotonic()

    def publish(self) -> None:
        """Publish the next message: its text ends with its number, counted from 1."""
        with self._lock:
            self.published += 1
            if not self._open:
                self.unheard += 1
            frame = wire.pack_string(f"message {self.published}")
            for connection, session in self._open.items():
                _write(connection, session, self.published, frame)

    def peers(self) -> list[str]:
        """Return the names of the subscribers that are connected."""
        with self._lock:
            return [session.peer for session in self._open.values()]

    def to_json(self) -> dict[str, Any]:
        """Return everything the summary wants to know, as plain data."""
        with self._lock:
            return {
                "topic": self.topic,
                "published": self.published,
                "unheard": self.unheard,
                "connected": len(self._open),
                "sessions": [session.to_json() for session in self._sessions],
            }


def _write(connection: socket.socket, session: Session, number: int, frame: bytes) -> None:
    """Write a frame; a connection that fails is ended, which wakes the thread that serves it."""
    session.note(number, time.monotonic())
    try:
        connection.sendall(frame)
    except OSError:
        end_connection(connection)


def _wait_for_end(connection: socket.socket) -> None:
    """Block until the subscriber closes; it has nothing to say after its header."""
    while True:
        try:
            if not connection.recv(1024):
                return
        except TimeoutError:
            continue
        except OSError:
            return
