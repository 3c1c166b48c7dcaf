"""Replies to ``getPid``, which the proxy calls often."""

import xmlrpc.client
from typing import Any, cast

import pytest

from rosproxy.ros1.clients.master_client import Unreachable
from rosproxy.ros1.clients.node_client import NodeClient
from rosproxy.ros1.registry.node_health import ProbeResult


def read_pid(value: Any) -> int | None:
    reply = xmlrpc.client.dumps((value,), methodresponse=True).encode()
    return NodeClient(cast(Any, None), 1.0).read_pid(reply)


def test_pids() -> None:
    assert read_pid([1, "", 17]) == 17
    assert read_pid([0, "no such method", 0]) == 0
    assert read_pid("text") is None


def test_a_document_in_place_of_a_pid_is_not_read() -> None:
    """Each value takes time to parse, and many nodes may send such a document every few seconds."""
    with pytest.raises(Unreachable) as caught:
        read_pid([1, "", [0] * 1000])
    assert caught.value.probe is ProbeResult.ANSWERED
