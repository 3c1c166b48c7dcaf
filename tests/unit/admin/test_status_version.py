"""Changes of a status that change the version."""

from typing import Any

import pytest

from rosproxy.admin.status_version import version_of
from rosproxy.shared.documents.status_document import read_status

NODE = {"nodes": ["/talker"], "address": "10.0.0.5:40001", "publishes": ["/chatter"]}
MEMBER = {
    "guid_prefix": "01.0f",
    "address": "10.0.0.6",
    "leases": [{"port": 11401, "datagrams": 3}],
}
LINK = {"peer": "robot:7447", "up": True, "since": 3.0}
SESSION = {"port": 7448, "mode": "peer", "zid": "ab"}
ZENOH: dict[str, Any] = {"ports": "7448-7467", "links": [LINK], "sessions": [SESSION]}
STATUS: dict[str, Any] = {
    "instance": "a",
    "uptime": 3.0,
    "master": {"up": True, "since": 2.0},
    "nodes": [NODE],
    "domains": [{"domain": 7, "inside": [MEMBER]}],
    "zenoh": ZENOH,
    "range_probe": {"reached": True, "age": 3.0},
    "problems": [{"age": 1.0, "subject": "master", "text": "refused"}],
}


def version(**more: Any) -> str:
    return version_of(read_status({**STATUS, **more}))


@pytest.mark.parametrize(
    "change",
    [
        {"uptime": 9.0},
        {"master": {"up": True, "since": 9.0, "round_trip": 0.1}},
        {"nodes": [{**NODE, "connections": [{"name": "/chatter"}], "state": "live"}]},
        {"domains": [{"domain": 7, "inside": [{**MEMBER, "leases": [{"port": 11401}]}]}]},
        {"problems": [{"age": 9.0, "subject": "master", "text": "refused"}]},
        {"range_probe": {"reached": True, "age": 300.0}},
        {"zenoh": {**ZENOH, "restarts": 1, "links": [{**LINK, "since": 9.0}]}},
        {"zenoh": {**ZENOH, "sessions": [{**SESSION, "without_node": 9.0}]}},
    ],
)
def test_what_only_passes_makes_no_version(change: dict[str, Any]) -> None:
    assert version(**change) == version()


@pytest.mark.parametrize(
    "change",
    [
        {"instance": "b"},
        {"retired": True},
        {"master": {"up": False}},
        {"master": {"up": True, "error": "odd"}},
        {"nodes": []},
        {"nodes": [{**NODE, "publishes": []}]},
        {"nodes": [{**NODE, "address": "10.0.0.7:40001"}]},
        {"nodes": [{**NODE, "state": "cleaned"}]},
        {"domains": []},
        {"domains": [{"domain": 7, "inside": [{**MEMBER, "leases": []}]}]},
        {"problems": []},
        {"range_probe": {"reached": False}},
        {"range_probe": {"reached": True, "from_proxy": "refused"}},
        {"range_probe": None},
        {"zenoh": None},
        {"zenoh": {**ZENOH, "failure": "no report for 10 s"}},
        {"zenoh": {**ZENOH, "links": [{**LINK, "up": False}]}},
        {"zenoh": {**ZENOH, "sessions": []}},
        {"zenoh": {**ZENOH, "nodes": [{"name": "/talker"}]}},
    ],
)
def test_each_change_of_nodes_and_ports_makes_a_version(change: dict[str, Any]) -> None:
    assert version(**change) != version()
