"""Tests “What is wrong” and “What happened” on the live page, with made-up nodes and links."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.browser.page import THIS_MACHINE, made_up
from tests.browser.test_picture import MARKED_BOXES, MARKED_ROWS, ROWS, fleet, texts
from tests.browser.webdriver import Browser, Json
from tests.ros.processes import wait_until
from tests.ros.topology import Place

CAUSES = """
return import("/findings.js").then(({ causesOf, titleOf }) => {
  const [nodes, links, findings] = arguments;
  const state = { nodes: new Map(Object.entries(nodes)), links: new Map(Object.entries(links)) };
  return causesOf({ ...state, findings }).map((cause) => `${titleOf(cause)}: ${cause.fix}`);
});
"""
AGES = """
return import("/findings.js").then(({ ageOf }) =>
  arguments[0].map(([seconds, older]) => ageOf({ older }, seconds)));
"""
OLDEST = """
return import("/findings.js").then(({ causesOf }) => {
  const row = { state: "broken", lane: "container", address: "10.0.0.1:1", text: "x", fix: "y" };
  const nodes = new Map(arguments[0].map(([wrong_since, may_be_older], index) =>
    [`/${index}`, { ...row, wrong_since, may_be_older }]));
  const [{ since, older }] = causesOf({ nodes, links: new Map(), findings: [] });
  return [since, older];
});
"""
FOLLOW = """
return import("/findings.js").then(({ follow, titleOf }) => {
  const seen = new Map();
  let events = [];
  arguments[0].forEach((titles, second) => {
    const causes = titles.map((what) => ({ key: what, what, count: 1, kind: "broken",
      since: what.length > 1 ? -1000 * Number(what.slice(1)) : Infinity }));
    events = follow(seen, causes, events, 1000 * second, second === 0);
  });
  return events.map(({ at, over, title, since }) => [at, over, title, since]);
});
"""
FOLLOW_NODES = """
return import("/findings.js").then(({ connect, emptyMemory, followNodes }) => {
  const memory = emptyMemory();
  let events = [];
  for (const [second, nodes, left_out] of arguments[0]) {
    if (nodes === null) connect(memory, 1000 * second);
    else {
      const state = { nodes: new Map(Object.entries(nodes)), left_out };
      events = followNodes(memory, state, events, 1000 * second);
    }
  }
  return events.map(({ at, title }) => `${at / 1000} ${title}`);
});
"""
ADD_NODE = """
const name = `/new${Math.floor(Date.now() / 1000)}`;
window.rosproxyPage.state.nodes.set(name, { lane: "container", address: "172.18.9.9:1" });
return [...document.querySelectorAll("#events li")].map((item) => item.textContent);
"""
MEND = """
const { state } = window.rosproxyPage;
const broken = [...state.nodes.values()].filter((node) => node.text);
for (const node of broken) Object.assign(node, { state: "ok", text: "", fix: "" });
"""
BUTTON = """
const button = document.querySelector(arguments[0]);
return [button.textContent, button.ariaLabel, button.hidden];
"""
NOTE_COPIES = """
document.addEventListener("copy", () => { window.copied = String(getSelection()); });
"""
PARTS = """
return import("/findings.js").then(({ partsOf }) => arguments[0].map((fix) => {
  const parts = partsOf(fix);
  const whole = parts.map(([text]) => text).join("");
  if (whole !== fix) throw new Error(`${whole} instead of ${fix}`);
  return parts.filter(([, isCommand]) => isCommand).map(([text]) => text);
}));
"""
FIXES = ("#findings li", "#rows tr", "#node-rows tr", "#details")
"""The places of fixes, each with a button that copies the command in the fix."""
SET_FIX = """
const { state } = window.rosproxyPage;
for (const node of state.nodes.values()) if (node.text) node.fix = arguments[0];
"""
COMMANDS = {
    "run rosnode cleanup (answer y)": ["rosnode cleanup"],
    "Do not run rosnode cleanup: it unregisters nodes that are alive": [],
    "restart the node; test from the proxy: nc -vz fd00::2 11412. If nc fails, open the port": [
        "nc -vz fd00::2 11412"
    ],
    "check the robot's proxy: docker ps; docker logs ros-1. Then run docker exec ros-1 rosproxy "
    "doctor": ["docker ps", "docker logs ros-1", "docker exec ros-1 rosproxy doctor"],
    "publish the ports: docker run -p 1:1, and let the firewall accept it": ["docker run -p 1:1"],
    "rosnode list -a shows the addresses of all nodes": ["rosnode list -a"],
    "find the programs: ss -ltnp 'sport >= :1 and sport <= :2'; or set another --port-range": [
        "ss -ltnp 'sport >= :1 and sport <= :2'"
    ],
    "run sysctl -w net.ipv4.ip_forward=1 on the node, then delete the proxy's pod": [
        "sysctl -w net.ipv4.ip_forward=1"
    ],
    "the robot's node: nc -vz 'a; docker rm -f x' 1; restart 'b; docker rm -f y'": [
        "nc -vz 'a; docker rm -f x' 1"
    ],
    "rootless Docker: set A=b; Docker Desktop: use an engine on Linux": [],
    "set --udp": [],
}
"""The commands in fixes. Nodes may have chosen the quoted names."""
CLEANUP = "run rosnode cleanup (answer y)"


@pytest.fixture
def machine() -> Place:
    """The machine of page and browser. No test here needs ROS."""
    return THIS_MACHINE


def broken(fix: str, **more: str) -> Json:
    return {"state": "broken", "text": "it does not answer", "fix": fix, **more}


def test_one_fix_in_one_place_is_one_cause(browser: Browser, tmp_path: Path) -> None:
    inside = {"lane": "container", "address": "172.18.0.2:1"}
    nodes: dict[str, Any] = {name: broken(CLEANUP, **inside) for name in ("/a", "/b")}
    camera = {"lane": "container", "address": "172.18.0.3:1", "place": "camera"}
    nodes["/c"] = broken(CLEANUP, proxy="ros1", **camera)
    nodes["/e"] = broken(CLEANUP, proxy="ros2", **camera)
    nodes["/d"] = {"lane": "robot", "address": "10.0.0.2"}
    links = {
        f"{source} {target}": broken(fix, name="/t", source=source, target=target)
        for source, target, fix in (
            ("/a", "/d", CLEANUP),
            ("/d", "/b", CLEANUP),
            ("/d", "/c", "on the machine of /c: nc -vz 10.0.0.1 11412"),
            ("/c", "/d", "on the machine of /d: nc -vz 10.0.0.1 11413"),
        )
    }
    findings = [
        {"severity": "warning", "subject": "ports", "text": "few are free", "fix": "more"},
        *({"severity": "warning", "subject": f"container {name}", "text": f"label x{n} is unknown",
           "fix": ""} for name, n in (("talker", 1), ("talker", 2), ("listener", 3))),
    ]  # fmt: skip
    with made_up(browser, tmp_path, 10):
        assert browser.run(CAUSES, nodes, links, findings) == [
            f"4 at 172.18.0.2: /a, …: {CLEANUP}",
            "2 at camera: /t from /c to /d, behind ros1, …: "
            "on the machine of /d: nc -vz 10.0.0.1 11413",
            f"/c, behind ros1, in camera: {CLEANUP}",
            f"/e, behind ros2, in camera: {CLEANUP}",
            "2 at talker: container talker, …: ",
            "ports: more",
            "container listener: ",
        ]


def test_the_age_of_a_cause(browser: Browser, tmp_path: Path) -> None:
    """The age is that of the oldest problem of the cause."""
    with made_up(browser, tmp_path, 10):
        assert browser.run(AGES, [[300, False], [10, True], [3600, True]]) == [
            "first seen 5 min ago",
            "age not known",
            "at least 60 min old",
        ]
        assert browser.run(OLDEST, [[60, False], [50, True]]) == [50_000, True]
        assert browser.run(OLDEST, [[50, False], [60, True]]) == [50_000, False]


def test_what_comes_and_goes_is_an_event(browser: Browser, tmp_path: Path) -> None:
    with made_up(browser, tmp_path, 10):
        follow = [["a"], ["a", "b"], ["b"], []]
        assert browser.run(FOLLOW, follow) == [
            [3000, True, "b", 1000],
            [2000, True, "a", 0],
            [1000, False, "b", 1000],
        ]
        assert browser.run(FOLLOW, [[], ["a7200"], []]) == [
            [2000, True, "a7200", -7_200_000],
            [1000, False, "a7200", -7_200_000],
        ]
        assert len(browser.run(FOLLOW, [[], *([[f"a{n}"] for n in range(90)])])) == 50


Look = tuple[float, Json | None, int]
"""The time in seconds, the nodes by key (None: a new connection), and ``left_out``."""
ONE = {"kind": "proxy", "lane": "host", "label": "one"}
TALKER = {"label": "/talker", "lane": "container", "place": "box", "proxy": "one"}
LISTENER = {"label": "/listener", "lane": "robot", "address": "10.0.0.2:1"}
HERE = {"one rosproxy": ONE, "one /talker": TALKER, "/listener": LISTENER}
CONNECTED: tuple[Look, ...] = ((0, None, 0), (10, HERE, 0))


def nodes_at(place: str, *names: str) -> Json:
    """Nodes in a container."""
    return {name: {**TALKER, "label": name, "place": place} for name in names}


@pytest.mark.parametrize(
    ("looks", "events"),
    [
        ([(11, {"one rosproxy": ONE, "/listener": LISTENER}, 0)],
         ["11 /talker went at box, behind one"]),
        ([(11, {**HERE, "/x": {**LISTENER, "label": "/x"}}, 0)], ["11 /x came at 10.0.0.2"]),
        ([(11, HERE | nodes_at("a", "/x", "/y"), 0), (12, HERE | nodes_at("a", "/y", "/z"), 0)],
         ["12 /z came, /x went at a, behind one", "11 2 nodes came (/x, …) at a, behind one"]),
        ([(11, {f"/n{n}": {**LISTENER, "address": f"10.0.1.{n}:1"} for n in range(9)} | HERE, 0)],
         ["11 9 nodes came at 9 machines or containers"]),
        ([(11, {**HERE, "x": {**LISTENER, "label": "/t"}}, 0), (12, HERE | nodes_at("a", "/t"), 0)],
         ["11 /t came at 10.0.0.2"]),
        ([(11, {"one rosproxy": ONE}, 5), (12, HERE, 0), (13, HERE, 0)], []),
    ],
)  # fmt: skip
def test_nodes_that_come_and_go_are_events(
    browser: Browser, tmp_path: Path, looks: list[Look], events: list[str]
) -> None:
    """Each machine or container has one event in a look, and many machines share one event.

    A node that was outside at first, and nodes that are left out, make no event.
    """
    with made_up(browser, tmp_path, 10):
        assert browser.run(FOLLOW_NODES, [*CONNECTED, *looks]) == events


@pytest.mark.parametrize(
    ("looks", "events"),
    [
        ([(0, {"one rosproxy": ONE}, 0), (9, HERE, 0), (10, HERE, 0), (11, HERE, 0)], []),
        ([*CONNECTED[1:], (20, None, 0), (20, {}, 0), (21, {"one rosproxy": ONE}, 0),
          (22, HERE, 0), (40, HERE, 0)], []),
        ([*CONNECTED[1:], (20, None, 0), (20, {"one rosproxy": ONE}, 0), (30, HERE, 0),
          (31, {"one rosproxy": ONE, "one /talker": TALKER}, 0)],
         ["31 /listener went at 10.0.0.2"]),
    ],
)  # fmt: skip
def test_a_new_connection_is_no_event(
    browser: Browser, tmp_path: Path, looks: list[Look], events: list[str]
) -> None:
    """The first documents lack nodes until the proxy has asked all nodes."""
    with made_up(browser, tmp_path, 10):
        assert browser.run(FOLLOW_NODES, [(0, None, 0), *looks]) == events


def test_a_proxy_that_is_replaced_is_one_event(browser: Browser, tmp_path: Path) -> None:
    """Its nodes and the nodes outside are not known to be gone while the proxy does not answer."""
    silent = {"one": {**ONE, "state": "broken", "text": "no data from this proxy"}}
    told = "proxy one: gone for {} s and back (replaced, restarted or not reachable)"
    looks = [
        *CONNECTED, (11, HERE, 0), (12, silent, 0), (60, silent, 0), (61, {"one rosproxy": ONE}, 0),
        (64, HERE, 0), (72, HERE, 0), (80, {"/listener": LISTENER}, 0), (83, HERE, 0),
        (99, HERE, 0),
    ]  # fmt: skip
    with made_up(browser, tmp_path, 10):
        assert browser.run(FOLLOW_NODES, looks) == [f"83 {told.format(3)}", f"61 {told.format(49)}"]


def test_nodes_that_flap_leave_room_for_fifty_events(browser: Browser, tmp_path: Path) -> None:
    flapping = [(11 + n, HERE | nodes_at("a", *["/x"][: n % 2]), 0) for n in range(90)]
    with made_up(browser, tmp_path, 10):
        assert len(browser.run(FOLLOW_NODES, [*CONNECTED, *flapping])) == 50


def test_a_node_that_comes_is_an_event_on_the_page(browser: Browser, tmp_path: Path) -> None:
    """The page reports only nodes that come after the first seconds."""
    with fleet(browser, tmp_path, 30):
        wait_until(
            "the page reports a node",
            lambda: any("at 172.18.9.9" in event for event in browser.run(ADD_NODE)),
            60,
        )
        assert not [event for event in texts(browser, "#events li") if "172.18.9.9" not in event]


def test_a_finding_is_shown_in_graph_and_table_and_leaves(browser: Browser, tmp_path: Path) -> None:
    with fleet(browser, tmp_path, 30):
        first = texts(browser, "#findings li:first-child span")
        assert first[0] == "BROKEN: 3 at 172.18.0.2: /arm/driver_of_the_unit_0, behind ros1, …"
        assert first[-1] == "first seen 5 min ago"
        address = browser.run("return location.href")
        browser.open("about:blank")
        browser.open(address)
        wait_until("the page shows rows again", lambda: browser.run(ROWS) > 0)
        assert texts(browser, "#findings li:first-child span") == first, "not the same age again"
        browser.run("document.querySelector('#findings .cause').click()")
        assert len(texts(browser, MARKED_BOXES)) == 3
        assert len(texts(browser, "#node-rows tr[aria-current]")) == 3
        assert not texts(browser, MARKED_ROWS), "a link is marked without this problem"
        browser.run(MEND)
        wait_until("the finding is over", lambda: len(texts(browser, "#events li")) == 1)
        (event,) = texts(browser, "#events li")
        assert "over after" in event
        assert first[0].removeprefix("BROKEN: ") in event
        assert not texts(browser, MARKED_BOXES)


def test_the_commands_in_a_fix(browser: Browser, tmp_path: Path) -> None:
    with made_up(browser, tmp_path, 10):
        assert browser.run(PARTS, [*COMMANDS]) == [*COMMANDS.values()]


def test_each_command_in_a_fix_has_a_button(browser: Browser, tmp_path: Path) -> None:
    """The button at a fix without a command copies the whole fix."""
    with fleet(browser, tmp_path, 30):
        browser.run(NOTE_COPIES)
        two = ["docker ps", "docker logs a"]
        check_buttons(browser, "run docker ps; docker logs a", ["Copy 1", "Copy 2"], two)
        check_buttons(browser, "restart the node", ["Copy"], ["restart the node"])


def check_buttons(browser: Browser, fix: str, buttons: list[str], copied: list[str]) -> None:
    """Give all nodes a fix, and press all buttons at the first cause."""
    place = "#findings li:first-child"
    browser.run(SET_FIX, fix)
    wait_until("the fix is shown", lambda: texts(browser, f"{place} .fix") == [fix])
    assert texts(browser, f"{place} .copy") == buttons
    for number, text in enumerate(copied, 1):
        button = f"{place} .copy:nth-child({number})"
        browser.run("document.querySelector(arguments[0]).focus()", button)
        browser.press(" ")
        assert browser.run("return window.copied") == text


def test_each_fix_has_a_button_that_copies_the_command(browser: Browser, tmp_path: Path) -> None:
    """Enter and the space bar press the button. This chooses no row."""
    with fleet(browser, tmp_path, 30):
        browser.run(NOTE_COPIES)
        browser.run("document.querySelector('#rows tr').click()")
        chosen = texts(browser, MARKED_ROWS)
        for place, key in zip(FIXES, ("\ue007", " ", "\ue007", " "), strict=True):
            check_copies(browser, place, key)
        assert texts(browser, MARKED_ROWS) == chosen
        browser.press("\ue00c")
        assert not texts(browser, "#rows tr:last-child .copy:not([hidden])")


def check_copies(browser: Browser, place: str, key: str) -> None:
    """Press a key at the first button of a place, which has to copy the first command there."""
    button = f"{place} .copy"
    text, label, hidden = browser.run(BUTTON, button)
    assert (text, hidden) == ("Copy", False)
    (command, *_) = texts(browser, f"{place} .command")
    assert label.startswith(f"Copy the command {command} for ")
    browser.run("document.querySelector(arguments[0]).focus()", button)
    browser.press(key)  # a script alone may not copy
    assert browser.run(BUTTON, button) == ["Copied", "Copied", False]
    assert browser.run("return window.copied") == command
    wait_until("the label is back", lambda: browser.run(BUTTON, button)[1] == label)
