"""``rosproxy status`` as text."""

from typing import Any

import pytest

from rosproxy.cli.status_table import render
from rosproxy.shared.documents.status_document import read_status
from rosproxy.shared.output.text import width
from tests.unit.status_json import make_connection, make_node, make_status


def shown(status: dict[str, Any], columns: int, lines: int | None = None) -> str:
    return render(read_status(status), columns, lines)


def lines_of(*nodes: dict[str, Any], columns: int = 120, **parts: Any) -> list[str]:
    return shown(make_status(*nodes, **parts), columns).split("\n")


def test_head_of_a_proxy_without_nodes() -> None:
    assert lines_of() == [
        "rosproxy 0.1.0, pid 42, up 1 min",
        "master   http://robot:11311 up for 1 min, round trip 1.2 ms (pid 7)",
        "ports    robot-host:45000-45099: 0 used, 100 free",
        "inside   ROS_MASTER_URI=http://<this host>:11311, networks 10.0.0.0/24",
        "",
        "No node has registered through the proxy yet.",
    ]


def test_head_names_offset_and_blocked_ports_and_the_published_master() -> None:
    lines = lines_of(
        ports={"advertise": "46000-46099", "blocked": 2, "free": 98},
        settings={"publish_master": 11411, "inside_networks": []},
    )
    assert lines[2] == (
        "ports    robot-host:46000-46099, here 45000-45099: 0 used, 98 free, "
        "2 held by other programs"
    )
    assert lines[3].endswith("networks none")
    assert lines[4] == "outside  ROS_MASTER_URI=http://robot-host:11411"


@pytest.mark.parametrize(
    ("reached", "by_master", "end"),
    [
        (True, "ok", "reached from outside"),
        (True, "unknown", "reached from this host"),
        (False, "missed", "NOT reached from outside"),
        (None, "unknown", "100 free"),
    ],
)
def test_head_tells_whether_outside_gets_in(reached, by_master, end) -> None:
    """The try of the proxy itself was told as one from outside, as with ROS 2."""
    status = {**make_status(), "range_probe": {"reached": reached, "from_master": by_master}}
    assert shown(status, 120).split("\n")[2].endswith(f", {end}")


def test_head_names_stand_ins() -> None:
    status = make_status()
    status["stand_ins"] = []
    assert "reached from inside" not in shown(status, 120)
    status["stand_ins"] = [
        {"port": port, "uri": f"http://r:{port}/", "connections": 2, "received_rate": 500.0}
        for port in range(4001, 4008)
    ]
    assert (
        "outside  reached from inside at 7 ports (14 connections, 3.5 kB/s in): "
        "4001 for http://r:4001/, 4002 for http://r:4002/, 4003 for http://r:4003/, "
        "4004 for http://r:4004/, 4005 for http://r:4005/ and 2 more"
    ) in shown(status, 250).split("\n")


@pytest.mark.parametrize(
    ("master", "line"),
    [
        (
            {"up": False, "error": "master http://robot:11311: connection refused"},
            "master   http://robot:11311 DOWN for 1 min: connection refused",
        ),
        ({"up": False, "error": ""}, "master   http://robot:11311 not asked yet"),
        ({"round_trip": None}, "master   http://robot:11311 up for 1 min (pid 7)"),
    ],
)
def test_master_line(master: dict[str, Any], line: str) -> None:
    assert lines_of(master=master)[1] == line


def test_a_node_with_everything() -> None:
    node = make_node(
        subscribes=["/clock"],
        services=["/talker/get_loggers"],
        parameters=["/rate"],
        connections=[make_connection(), make_connection(caller_id="", sent=12, sent_rate=50.0)],
    )
    assert lines_of(node)[5:] == [
        "NODE     INSIDE          OUTSIDE           STATE  PUB  SUB  SRV  CONN       OUT     IN",
        "/talker  10.0.0.5:40001  robot-host:45000  ok       1    1    1     2  1.2 kB/s  0 B/s",
        "    publishes  /chatter",
        "    subscribes /clock",
        "    services   /talker/get_loggers",
        "    parameters /rate",
        "    connected  topic /chatter with /listener at 192.168.0.9: 3.4 MB out, 120 B in",
        "    connected  topic /chatter with ? at 192.168.0.9: 12 B out, 120 B in",
    ]


def test_nodes_that_share_an_address_and_one_without_a_name() -> None:
    lines = lines_of(make_node(nodes=["/manager", "/nodelet"]), make_node(nodes=[], publishes=[]))
    assert lines[6].startswith("/manager +1  ")
    assert "    also       /nodelet" in lines
    assert lines[-1].startswith("(unnamed)    10.0.0.5:40001")


def test_long_lists_are_cut() -> None:
    node = make_node(
        publishes=[f"/topic_{number}" for number in range(100)],
        connections=[make_connection() for _ in range(20)],
    )
    lines = lines_of(node, columns=80)
    assert [line for line in lines if "/topic_" in line][-1].endswith(" …")
    assert sum("/topic_" in line for line in lines) == 3
    assert sum("connected " in line for line in lines) == 8
    assert lines[-1] == "    … 12 connections more"


def test_what_the_proxy_has_left_out_is_told() -> None:
    lines = lines_of(make_node(left_out=1234))
    assert [line for line in lines if "1234 more names and connections" in line]
    assert not [line for line in lines_of(make_node()) if "not shown" in line]
    assert (
        "left out 1234 names and entries: /status is bounded, see docs/reference/limits.md" in lines
    )
    assert not [line for line in lines_of(make_node()) if "left out" in line]


def test_a_narrow_terminal_gives_addresses_a_line_of_their_own() -> None:
    node = make_node("/a/very/long/node/name/of/some/driver_1795249066559")
    lines = lines_of(node, columns=60)
    heading = lines[lines.index("") + 1]
    assert heading.split() == ["NODE", "STATE", "PUB", "SUB", "SRV", "CONN", "OUT", "IN"]
    assert "    at         10.0.0.5:40001, outside robot-host:45000" in lines
    assert max(map(width, lines)) <= 60


@pytest.mark.parametrize("columns", [60, 80, 100, 120, 200])
def test_no_line_is_wider_than_the_terminal(columns: int) -> None:
    node = make_node("/節點/" + "名" * 40, connections=[make_connection()], services=["/s"] * 50)
    problem = {"age": 3.0, "subject": "/節點", "text": "does not answer " * 10}
    lines = lines_of(node, make_node(), columns=columns, problems=[problem])
    assert max(map(width, lines)) <= columns


def test_problems_stand_at_the_end() -> None:
    problem = {"age": 125.0, "subject": "/talker", "text": "does not answer"}
    masters = {"age": 3.0, "subject": "master", "text": "told by the master's line"}
    lines = lines_of(make_node(), problems=[problem, masters])
    assert lines[-3:] == [
        "",
        "problems (run rosproxy doctor to examine them):",
        "  2 min ago  /talker: does not answer",
    ]


def test_names_cannot_reach_the_terminal() -> None:
    evil = "\x1b]0;owned\x07\n\u202e"
    connection = make_connection(**dict.fromkeys(("caller_id", "name", "kind", "peer"), evil))
    said: dict[str, Any] = dict.fromkeys(("state", "advertised_uri", "address"), evil)
    for name in ("nodes", "publishes", "subscribes", "services", "parameters"):
        said[name] = [evil, evil]
    text = shown(
        make_status(
            make_node(connections=[connection], **said),
            problems=[{"age": 1.0, "subject": evil, "text": evil}],
            master={"uri": evil, "error": evil, "up": False},
        ),
        120,
    )
    assert all(line.isprintable() for line in text.split("\n"))


def test_a_short_screen_shows_problems_before_nodes() -> None:
    problem = {"age": 1.0, "subject": "/talker", "text": "gone"}
    nodes = [make_node(f"/node_{number}", 45000 + number) for number in range(20)]
    text = shown(make_status(*nodes, problems=[problem]), 120, lines=12)
    lines = text.split("\n")
    assert len(lines) == 12
    assert "  1.0 s ago  /talker: gone" in lines
    assert "publishes" not in text
    assert lines[-1] == "… 18 lines more: rosproxy status"


def test_a_screen_that_is_long_enough_shows_details() -> None:
    status = make_status(make_node())
    assert shown(status, 120, lines=50) == shown(status, 120)


def a_plane(**changes: Any) -> dict[str, Any]:
    return {
        "plane": "kernel",
        "port": 45050,
        "reason": "",
        "connections": 2,
        "sent": 3_400_000,
        "received": 120,
        "sent_rate": 1200.0,
        "received_rate": 10.0,
        **changes,
    }


def planes(*nodes: dict[str, Any], **whole: str) -> str:
    status = make_status(*nodes)
    status["data_plane"] = {"mode": "auto", "plane": "kernel", "reason": ""} | whole
    return shown(status, 120)


def test_the_kernels_connections_count_as_the_proxys_own() -> None:
    text = planes(make_node(data_plane=a_plane(), connections=[make_connection()]))
    assert "topics   forwarded by the kernel (data plane auto)" in text
    row = next(line for line in text.split("\n") if line.startswith("/talker"))
    assert row.split()[-5:] == ["3", "2.4", "kB/s", "10", "B/s"]
    assert "kernel     2 connections through port 45050: 3.4 MB out, 120 B in as IP packets" in text


def test_why_a_node_is_not_forwarded_is_told_where_others_are() -> None:
    plane = a_plane(plane="splice", port=None, reason="port 45050 is in use", connections=0)
    node = make_node(data_plane=plane)
    assert "kernel     not used: port 45050 is in use" in planes(node)
    text = planes(node, plane="splice", reason="nft is not installed")
    assert "topics   relayed by the proxy (splice): nft is not installed" in text
    assert "not used" not in text


def test_the_policy_and_what_it_hides() -> None:
    status = make_status()
    status["policy"] = {
        "layers": [
            {"name": "--policy", "mode": "enforce", "rules": ["deny publish /a", "deny serve *"]},
            {"name": "trial\x1b", "mode": "audit", "rules": ["deny slave *"]},
        ],
        "hidden": [
            {"kind": "publish", "name": f"/t{i}", "node": "/n", "reason": "policy of --policy"}
            for i in range(21)
        ],
    }
    lines = shown(status, 120).split("\n")
    head = "policy   --policy: 2 rules, trial\\x1b: 1 rule (audit only); 21 names hidden"
    assert head in lines
    start = lines.index("hidden from outside:")
    assert lines[start + 1] == "  publish /t0 of /n  policy of --policy"
    assert lines[start + 21] == "    … 1 name more: rosproxy status --json"
