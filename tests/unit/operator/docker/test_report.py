"""The texts for people."""

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.shared.output.text import width
from rosproxy_operator.docker import host_status
from rosproxy_operator.docker.host_status import HostStatus
from rosproxy_operator.docker.planner.actions import (
    Action,
    Connect,
    Create,
    CreateNetwork,
    CreateSandbox,
    Disconnect,
    Remove,
    Rename,
    Restart,
    Start,
    Unpause,
)
from rosproxy_operator.docker.planner.report import render
from rosproxy_operator.docker.settings import PlanSettings
from tests.unit.operator.docker.builders import PLACE, RANGE

PROXY: dict[str, Any] = {
    "name": "rosproxy-robot-eefee4",
    "ros": "1",
    "domain": None,
    "peers": [],
    "links": {},
    "lan_relay": None,
    "master_uri": "http://robot:11311",
    "master_address": "192.0.2.7",
    "advertise_host": "192.0.2.10",
    "range": "11400-11431",
    "state": "running",
    "reachable": True,
    "master_up": True,
    "reached": True,
    "networks": ["app"],
    "data_plane": "splice",
    "used": 2,
    "free": 30,
    "problems": [],
}
NODES = [
    {
        "names": ["/talker", "/rosout"],
        "address": "172.18.0.2:40001",
        "advertised_uri": "http://192.0.2.10:11400/",
        "state": "alive",
    },
]
TALKER: dict[str, Any] = {
    "name": "talker",
    "state": "running",
    "proxy": "rosproxy-robot-eefee4",
    "networks": ["app"],
    "addresses": {"app": "172.18.0.2"},
    "nodes": NODES,
    "ros": "1",
    "participants": [],
    "zenoh_nodes": [],
    "redirect": None,
}
LISTENER = {**TALKER, "name": "listener", "proxy": None, "nodes": []}
STATUS = {
    "version": "1.0",
    "uplink": "0-rosproxy",
    "operator": "http://127.0.0.1:11313",
    "proxies": [PROXY],
    "containers": [TALKER, LISTENER],
    "problems": [],
    "actions": [],
}

ACTIONS: list[tuple[Action, str]] = [
    (CreateNetwork("0-rosproxy"), "create network 0-rosproxy, a bridge: the uplink of all proxies"),
    (
        CreateSandbox("p-ports", PLACE, RANGE),
        "create container p-ports: sandbox with ports 11400-11431 for the proxy of the master "
        "http://robot:11311",
    ),
    (
        Create("p", PLACE, RANGE, "p-ports", replaces="p-old"),
        "create container p: proxy of the master http://robot:11311 at 192.0.2.10, ports "
        "11400-11431 of p-ports, instead of p-old",
    ),
    (Start("p"), "start container p"),
    (Restart("p"), "restart container p"),
    (Unpause("p"), "resume container p"),
    (Rename("p", "p-old"), "rename container p to p-old"),
    (Connect("p", "app", ("a", "b")), "connect container p to network app as a, b"),
    (Connect("p", "0-rosproxy", ()), "connect container p to network 0-rosproxy"),
    (Disconnect("p", "app"), "disconnect container p from network app"),
    (Remove("p", "made anew"), "remove container p (made anew)"),
    (
        Remove("p", "done", retire=True),
        "remove container p (done), after the proxy has told outside that its nodes have ended",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("action", "text"), ACTIONS)
def test_each_action_is_one_line(action: Action, text: str) -> None:
    assert str(action) == text


@pytest.mark.parametrize(
    ("actions", "problems", "lines", "code"),
    [
        (
            ["start container a", "start container b"],
            [],
            ["start container a", "start container b"],
            3,
        ),
        (
            [],
            [{"subject": "uplink", "text": "odd", "fatal": True}],
            ["Nothing to do.", "uplink: odd"],
            1,
        ),
        (
            [],
            [{"subject": "uplink", "text": "odd", "fatal": False}],
            ["Nothing to do.", "uplink: odd"],
            0,
        ),
        (
            ["start container a\nuplink: odd"],
            [{"subject": "container a\r", "text": "label rosproxy.\x1b[2J\nb", "fatal": False}],
            ["start container a\\nuplink: odd", "container a\\r: label rosproxy.\\x1b[2J\\nb"],
            3,
        ),
    ],
)
def test_a_plan_is_its_lines_and_its_exit_code(
    actions: list[str],
    problems: list[dict[str, Any]],
    lines: list[str],
    code: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    async def survey(settings: PlanSettings) -> dict[str, Any]:
        return {"actions": actions, "problems": problems}

    monkeypatch.setattr(host_status, "survey", survey)
    host = HostStatus(PlanSettings(), operator=None)
    assert host_status.show_plan(host, as_json=False, wait=0) == code
    assert capsys.readouterr().out.splitlines() == lines
    assert host_status.show_plan(host, as_json=True, wait=0) == code
    assert json.loads(capsys.readouterr().out) == {"actions": actions, "problems": problems}


def test_a_plan_waits_for_a_proxy_that_has_just_been_started(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    silent = {"subject": "proxy a", "text": "does not answer", "fatal": True}
    looks: list[dict[str, Any]] = [
        {"actions": ["start container a"], "problems": []},
        {"actions": [], "problems": [silent]},
        {"actions": [], "problems": []},
    ]

    async def survey(settings: PlanSettings) -> dict[str, Any]:
        return looks.pop(0)

    monkeypatch.setattr(host_status, "survey", survey)
    monkeypatch.setattr(host_status, "WAIT_INTERVAL_S", 0.0)
    host = HostStatus(PlanSettings(), operator=None)
    assert host_status.show_plan(host, as_json=False, wait=60) == 0
    assert capsys.readouterr().out.splitlines() == ["Nothing to do."]


@pytest.mark.parametrize(
    ("proxy", "code"),
    [
        ({}, 0),
        ({"reached": None}, 0),
        ({"reached": False}, 1),
        ({"master_up": False}, 1),
        ({"links": {"robot:7447": True}}, 0),
        ({"links": {"robot:7447": True, "arm:7447": False}}, 1),
        ({"reachable": False, "master_up": None, "reached": None}, 1),
    ],
)
def test_the_status_is_good_if_every_proxy_can_do_its_work(
    proxy: dict[str, Any], code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def survey(settings: PlanSettings) -> dict[str, Any]:
        return {**STATUS, "proxies": [{**PROXY, **proxy}]}

    monkeypatch.setattr(host_status, "survey", survey)
    host = HostStatus(PlanSettings(), operator=None)
    assert host_status.show_status(host, as_json=True, wait=0) == code


def test_the_whole_status() -> None:
    assert render(STATUS, 100).splitlines() == [
        "rosproxy-operator 1.0: 2 containers, 1 proxy, uplink network 0-rosproxy",
        "Live page of all proxies: http://127.0.0.1:11313/",
        "",
        "PROXY                  STATE    MASTER OR DOMAIN    OUTSIDE     PORTS",
        "rosproxy-robot-eefee4  running  http://robot:11311  192.0.2.10  11400-11431 2 used",
        "",
        "CONTAINER  STATE    PROXY                  PORTS        NODES",
        "talker     running  rosproxy-robot-eefee4  11400-11431  1",
        "    /talker  /rosout",
        "listener   running  -                      -            0",
    ]


def test_it_says_when_no_operator_has_told_it() -> None:
    assert "No operator was asked" in render({**STATUS, "operator": None}, 100)
    assert "No operator was asked" not in render(STATUS, 100)


def test_what_is_wrong_stands_where_it_belongs() -> None:
    proxy = {**PROXY, "reachable": False, "master_up": False, "used": None, "problems": ["ill"]}
    status = {
        **STATUS,
        "proxies": [proxy],
        "problems": [
            {"subject": "container listener", "text": "no master is known", "fatal": True},
            {"subject": "network 0-a", "text": "can't be joined", "fatal": True},
        ],
        "actions": ["start container x"],
    }
    text = render(status, 120)
    assert "running, no answer  http://robot:11311 DOWN" in text
    assert "\n    ! ill\n" in text
    assert text.endswith(
        "\n    ! no master is known\n"
        "\nproblems:\n  network 0-a: can't be joined\n"
        "\n1 step left:\n  start container x"
    )


def test_nothing_there() -> None:
    text = render({**STATUS, "proxies": [], "containers": []}, 80)
    assert "No proxy." in text
    assert "No container is labelled: docker run --label rosproxy.enable=true" in text


@pytest.mark.parametrize("lines", [1, 4, 8, 20, 100])
def test_a_bound_on_lines(lines: int) -> None:
    status = {**STATUS, "containers": [TALKER] * 30}
    text = render(status, 100, lines).splitlines()
    assert len(text) <= lines
    if lines < 100:
        assert "more: rosproxy-operator docker status" in text[-1]


NASTY = st.text(st.sampled_from("ab\x1b[2J\u202e\n\r\t漢 "), max_size=40)


@given(NASTY, st.integers(30, 200), st.none() | st.integers(2, 30))
def test_hostile_names_do_no_harm(name: str, columns: int, lines: int | None) -> None:
    status = {
        **STATUS,
        "uplink": name,
        "proxies": [{**PROXY, "name": name, "master_uri": name, "problems": [name]}],
        "containers": [{**TALKER, "name": name, "proxy": name, "nodes": [{"names": [name]}]}],
        "problems": [{"subject": name, "text": name, "fatal": True}],
        "actions": [name],
    }
    for text in render(status, columns, lines).splitlines():
        assert text.isprintable()
        assert width(text) >= 0
    action = Connect(name, name, (name,))
    assert str(action).isprintable()


DOMAIN = {**PROXY, "name": "rosproxy-domain-0-7ec54e", "ros": "2", "domain": 0, "lan_relay":
"running",
          "master_uri": "", "master_up": False, "range": "11432-11463", "used": 3}  # fmt: skip
PARTICIPANT = {
    "guid_prefix": "01.0f.56.e7.01.00.c2.37.00.00.00.00",
    "vendor": "Fast DDS",
    "nodes": ["/talker", "/bad\x1b[2J"],
    "address": "172.18.0.2",
    "ports": [11433, 11434, 11435],
    "publishes": ["/out", "/rosout"],
    "subscribes": [],
    "services": ["/talker/get_parameters"],
    "problem": "",
}


def test_what_leads_to_the_proxy_is_told() -> None:
    def told(in_place: bool) -> str:
        redirect = {"master": "192.0.2.7:11311", "in_place": in_place}
        return render({**STATUS, "containers": [{**TALKER, "redirect": redirect}]}, 120)

    assert "    192.0.2.7:11311 is redirected to the proxy" in told(True)
    assert "    192.0.2.7:11311 is not redirected to the proxy yet" in told(False)


def test_both_versions_side_by_side() -> None:
    again = {**TALKER, "proxy": DOMAIN["name"], "ros": "2", "nodes": []}
    unnamed = {**PARTICIPANT, "nodes": [], "problem": "no port is free"}
    again["participants"] = [PARTICIPANT, unnamed]
    every = {**STATUS, "proxies": [PROXY, DOMAIN], "containers": [TALKER, again]}
    wrong = {"subject": "container talker", "text": "is odd", "fatal": False}
    text = render({**every, "problems": [wrong]}, 120)
    assert "1 container, 2 proxies" in text
    assert "running  domain 0  " in text
    topics = "publishes /out  /rosout; serves /talker/get_parameters"
    assert text.count(f"    Fast DDS: {topics}") == 1
    assert text.count(f"    /talker, /bad\\x1b[2J (Fast DDS): {topics}") == 1
    assert "talker     running  rosproxy-domain-0-7ec54e  11432-11463  2 participants" in text
    assert (text.count("! no port is free"), text.count("! is odd")) == (1, 1)
    deaf = {**DOMAIN, "lan_relay": None}
    assert "domain 0, no LAN relay" in render({**every, "proxies": [deaf]}, 120)


def test_rmw_zenoh_is_told_with_its_links_and_nodes() -> None:
    routers = {
        **PROXY, "name": "rosproxy-zenoh-1f3a9c", "ros": "zenoh", "master_uri": "",
        "master_up": None, "advertise_host": "", "range": "7448-7479", "used": None,
        "links": {"arm:7447": True, "robot:7447": False},
    }  # fmt: skip
    node = {"name": "/talker", "domain": "0", "publishes": ["/out"], "subscribes": [],
            "services": ["/add"]}  # fmt: skip
    talker = {**TALKER, "proxy": routers["name"], "ros": "zenoh", "nodes": [],
              "zenoh_nodes": [node]}  # fmt: skip
    text = render({**STATUS, "proxies": [routers], "containers": [talker]}, 120)
    assert "running  rmw_zenoh         arm:7447, robot:7447 DOWN  7448-7479" in text
    assert "rosproxy-zenoh-1f3a9c  7448-7479  1" in text
    assert "    /talker: publishes /out; serves /add" in text
    assert "no peers" in render({**STATUS, "proxies": [{**routers, "links": {}}]}, 120)
