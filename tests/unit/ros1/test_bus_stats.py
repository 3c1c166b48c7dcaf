"""Replies to ``getBusStats``."""

import xmlrpc.client
from typing import Any

import pytest

from rosproxy.ros1.clients.master_client import MasterError, read_value
from rosproxy.ros1.protocol.bus_stats import IN, MOST_CONNECTIONS, read_bus_stats

STATS = [[["/chatter", [[1, 48, 48, 3, 0]]]], []]


def reply(value: Any) -> bytes:
    return xmlrpc.client.dumps((value,), methodresponse=True).encode()


def test_roscpp_gives_the_value_without_a_status_code() -> None:
    assert read_value("getBusStats", reply(STATS)) == STATS


def test_rospy_gives_a_triple() -> None:
    assert read_value("getBusStats", reply([1, "bus stats", [*STATS, []]])) == [*STATS, []]


@pytest.mark.parametrize("value", [[], [[]], [1, 2], [0, "no", 0], "text", [[], [], []]])
def test_anything_else_is_no_answer(value: object) -> None:
    with pytest.raises(MasterError):
        read_value("getBusStats", reply(value))


def test_other_methods_need_a_triple() -> None:
    with pytest.raises(MasterError):
        read_value("getBusInfo", reply(STATS))


def test_several_rows_of_a_topic_share_the_bound_of_connections() -> None:
    """The growth compares each new connection with each connection that has ended."""
    rows = [["/chatter", [[first + n, 48, 3] for n in range(200)]] for first in (0, 200, 400)]
    assert len(read_bus_stats([[], rows])[IN, "/chatter"]) == MOST_CONNECTIONS
