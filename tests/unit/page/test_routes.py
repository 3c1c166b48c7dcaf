"""The events and documents that the page sends: encoded once for all watchers."""

from typing import Any

import pytest

from rosproxy.page import routes
from rosproxy.page.feed import Feed
from rosproxy.page.routes import Page
from rosproxy.page.visitors import Visitors
from rosproxy.shared.tasks import Tasks


def document(state: str) -> dict[str, Any]:
    return {"nodes": {"/talker": {"state": state}}, "links": {}, "left_out": 0}


def test_a_document_is_encoded_once_whatever_its_watchers_have(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A watcher that came anew, next to one that stayed, cost 70 ms for a document of 4 MB."""
    encoded = list[object]()

    def encode(value: object) -> bytes:
        encoded.append(value)
        return b"{}"

    monkeypatch.setattr(routes, "encode", encode)
    page = Page(Feed(Tasks(), lambda: pytest.fail("no watcher")), Visitors(None, lambda: 0.0))
    former = document("ok")
    newest = document("broken")
    for _ in range(5):
        assert page._event(None, newest) == b"event: all\ndata: {}\n\n"
        assert page._event(former, newest) == b"event: change\ndata: {}\n\n"
        assert page._encode(newest) == b"{}"
    assert encoded == [newest, {"nodes": newest["nodes"]}]
