"""An engine on loopback, to which DOCKER_HOST leads."""

import json
import re
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest

Json = dict[str, Any]


class Handler(BaseHTTPRequestHandler):
    server: "FakeEngine"

    def answer(self) -> None:
        path = re.sub(r"^/v1\.\d+|\?.*$", "", self.path)
        call = f"{self.command} {path}"
        length = int(self.headers.get("Content-Length") or 0)
        self.server.calls[call] = json.loads(self.rfile.read(length) or "null")
        reply = {} if self.command != "GET" else self.server.knows.get(path)
        missing = (404, f"no such container: {path}") if reply is None else (200, "")
        status, message = self.server.refuses.get(call, missing)
        self.send_response(status)
        self.end_headers()
        self.wfile.write(json.dumps({"message": message} if message else reply).encode())

    do_GET = do_POST = do_DELETE = answer  # noqa: N815

    def log_message(self, *_: object) -> None:
        pass


class FakeEngine(ThreadingHTTPServer):
    """An engine of API 1.41 that ``knows`` answers to GET by path, and says yes to all else.

    ``refuses`` are answers by call, ``POST /networks/create``; ``calls`` has the bodies of all
    calls that came.
    """

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.calls: Json = {}
        self.refuses: dict[str, tuple[int, str]] = {}
        self.rows: list[Json] = []
        self.knows: Json = {
            "/version": {"ApiVersion": "1.41"},
            "/events": {"Action": "start"},
            "/containers/json": self.rows,
            "/networks": [],
        }

    def add(self, row: Json, inspected: Json) -> None:
        self.rows.append(row)
        self.knows[f"/containers/{row['Id']}/json"] = inspected


@pytest.fixture
def engine(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeEngine]:
    with FakeEngine() as engine:
        threading.Thread(target=engine.serve_forever, args=(0.01,), daemon=True).start()
        monkeypatch.setenv("DOCKER_HOST", f"tcp://127.0.0.1:{engine.server_port}")
        yield engine
        engine.shutdown()
