"""Tests the graph of the live page on the screen, with 5 to 1,000 made-up nodes.

The pages are pages of an operator with three proxies (`tests.browser.fleet`). No test here needs
ROS: page and browser run on this machine.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.browser.page import DETAILS, THIS_MACHINE, made_up
from tests.browser.webdriver import Browser
from tests.ros.processes import wait_until
from tests.ros.topology import Place

SIZES = (5, 30, 100, 1000)
MOST_UNFOLDED = 100
"""Most nodes for a check of the unfolded graph. With more nodes, this takes minutes."""
GEOMETRY = Path(__file__).with_name("geometry.js").read_text()
NODES = 'return document.querySelectorAll("#boxes .box.node, #boxes .box.participant").length'
ROWS = "return document.querySelectorAll('#rows tr').length"
TEXTS = "return [...document.querySelectorAll(arguments[0])].map((item) => item.textContent)"
MARKED_ROWS = "#rows tr[aria-current] td:nth-child(2)"
MARKED_BOXES = ".box:not(.line)[aria-current]"
LEVEL = "return document.querySelector('#zoom-level').textContent"
SCROLLED = """
const graph = document.querySelector("#graph");
return [graph.scrollLeft, graph.scrollTop, graph.scrollWidth - graph.clientWidth];
"""
AT_POINT = """
const box = document.elementFromPoint(arguments[0], arguments[1]).closest(".box");
return box ? box.title : "";
"""
CENTRE = """
const { left, top, width, height } = document.querySelector("#graph").getBoundingClientRect();
const [x, middle] = [left + width / 2, top + height / 2];
for (let y = middle; y < top + height; y += 1) {
  if (document.elementFromPoint(x, y).closest(".box.line")) return [x, y + 5];
}
"""
CTRL = 2
"""The modifier of `Input.dispatchMouseEvent`."""
PROXY_LABELS = "#boxes .proxy .fix"
MARKED_FINDINGS = "#findings li[aria-current] .what"
MARKED_LINES = ".box.line[aria-current]"
SHOWN = """
return { boxes: [...document.querySelectorAll("#boxes .box")].map((box) => box.title),
  marked: [...document.querySelectorAll(".box[aria-current]")].map((box) => box.title),
  filter: document.querySelector("#filter").value };
"""
FOLDS = """
return import("/picture.js").then(({ boxesOf }) => {
  const chosen = { unfoldAll: false, turned: new Map(), depths: {} };
  return arguments[0].map((count) => {
    const numbers = [...Array(count).keys()];
    const nodes = new Map(numbers.map((number) =>
      [`/n${number}`, { lane: "container", address: `172.18.0.${number % 4}:1` }]));
    const { lanes, depths } = boxesOf(nodes, new Set(nodes.keys()), chosen);
    chosen.depths = depths;
    return lanes[2].length;
  });
});
"""
PICTURE = """
return import("/picture.js").then(({ boxesOf }) => {
  const nodes = new Map(arguments[0].map((node, index) => [`/n${index}`, node]));
  const chosen = { unfoldAll: false, turned: new Map(arguments[1]), depths: {} };
  const { lanes } = boxesOf(nodes, new Set(nodes.keys()), chosen);
  return lanes.map((lane) => lane.map(({ level, label, note }) =>
    `${"  ".repeat(level)}${label}, ${note}`));
});
"""


@pytest.fixture
def machine() -> Place:
    """The machine of page and browser."""
    return THIS_MACHINE


@contextmanager
def fleet(browser: Browser, folder: Path, nodes: int) -> Iterator[None]:
    """Show a page with ``nodes`` nodes of three proxies in the browser."""
    with made_up(browser, folder, nodes, "fleet"):
        wait_until("the page shows rows", lambda: browser.run(ROWS) > 0)
        yield


def click(browser: Browser, selector: str, text: str) -> None:
    """Click the first element with a text."""
    script = """
    const all = [...document.querySelectorAll(arguments[0])];
    all.find((item) => item.textContent.includes(arguments[1])).click();
    """
    browser.run(script, selector, text)


def texts(browser: Browser, selector: str) -> list[str]:
    """The texts of all elements that a selector matches."""
    found: list[str] = browser.run(TEXTS, selector)
    return found


@pytest.mark.parametrize("nodes", SIZES)
def test_the_picture_reads(browser: Browser, tmp_path: Path, nodes: int) -> None:
    with fleet(browser, tmp_path, nodes):
        for width, height in ((1500, 1000), (2560, 1300), (360, 740)):
            browser.resize(width, height)
            wait_until("the picture has this width", lambda: not geometry(browser))
        browser.run("document.querySelector('#unfold').click()")
        wait_until("each node has a box", lambda: browser.run(NODES) >= nodes)
        if nodes <= MOST_UNFOLDED:
            assert geometry(browser) == []


@contextmanager
def zoomable(browser: Browser, folder: Path, width: int, height: int) -> Iterator[None]:
    """Show a page with a screen of this size, with the graph in view and the focus on the graph."""
    with fleet(browser, folder, 15):
        browser.resize(width, height)
        wait_until("the picture has this width", lambda: not geometry(browser))
        graph = "const graph = document.querySelector('#graph');"
        browser.run(f"{graph} graph.focus(); graph.scrollIntoView();")
        yield


def mouse(browser: Browser, kind: str, x: float, y: float, **more: Any) -> None:
    """Send an event of the mouse to the browser."""
    browser.devtools("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)


def level(browser: Browser) -> int:
    """The zoom of the graph in percent."""
    return int(browser.run(LEVEL).removesuffix(" %"))


@pytest.mark.parametrize(("width", "height"), [(1500, 1000), (360, 740)])
def test_keys_and_buttons_zoom_the_graph(
    browser: Browser, tmp_path: Path, width: int, height: int
) -> None:
    """At each zoom, text has at least 11 px, no labels overlap, and the lanes fill the width."""
    with zoomable(browser, tmp_path, width, height):
        browser.press("++")
        assert level(browser) == 156
        assert geometry(browser) == []
        browser.press("0")
        assert 92 <= level(browser) <= 100
        assert geometry(browser) == []
        assert browser.run(SCROLLED)[:2] == [0, 0]
        click(browser, "#zoom button", "+")
        assert level(browser) > 100
        for _ in range(9):
            click(browser, "#zoom button", "\N{MINUS SIGN}")
        assert level(browser) == 92
        assert geometry(browser) == []


def test_the_wheel_with_ctrl_zooms_at_the_pointer(browser: Browser, tmp_path: Path) -> None:
    """The wheel without Ctrl scrolls."""
    with zoomable(browser, tmp_path, 1500, 600):
        x, y = browser.run(CENTRE)
        box = browser.run(AT_POINT, x, y)
        assert box
        mouse(browser, "mouseWheel", x, y, deltaX=0, deltaY=-300, modifiers=CTRL)
        wait_until("the graph is larger", lambda: level(browser) > 200)
        assert browser.run(AT_POINT, x, y) == box
        assert geometry(browser) == []
        before = level(browser)
        _, top, _ = browser.run(SCROLLED)
        mouse(browser, "mouseWheel", x, y, deltaX=0, deltaY=120)
        wait_until("the graph scrolls", lambda: browser.run(SCROLLED)[1] > top)
        assert level(browser) == before


def test_the_mouse_moves_the_graph_and_chooses_nothing(browser: Browser, tmp_path: Path) -> None:
    with zoomable(browser, tmp_path, 1500, 1000):
        browser.press("+++")
        left, _, hidden = browser.run(SCROLLED)
        assert 100 < left < hidden - 100, "there is no room to move the graph"
        x, y = browser.run(CENTRE)
        mouse(browser, "mousePressed", x, y, button="left", buttons=1, clickCount=1)
        mouse(browser, "mouseMoved", x + 80, y, button="left", buttons=1)
        mouse(browser, "mouseReleased", x + 80, y, button="left", clickCount=1)
        wait_until("the graph moves", lambda: abs(browser.run(SCROLLED)[0] - left + 80) < 2)
        moved = browser.run(SCROLLED)
        mouse(browser, "mouseMoved", x, y)
        # The button was pressed outside the graph, for example to mark text.
        mouse(browser, "mouseMoved", x + 40, y, button="left", buttons=1)
        assert browser.run(SCROLLED) == moved
        assert not browser.run(DETAILS)
        assert geometry(browser) == []
        click(browser, "#boxes .proxy", "domain-7")
        assert browser.run(DETAILS), "a box cannot be chosen any more"


def test_each_proxy_has_its_version_of_ros(browser: Browser, tmp_path: Path) -> None:
    with fleet(browser, tmp_path, 30):
        labels = texts(browser, PROXY_LABELS)
        assert sorted(labels) == ["ROS 1", "ROS 2, domain 0", "ROS 2, domain 7"]


def geometry(browser: Browser) -> list[str]:
    """The faults of the graph on the screen. Raises AssertionError without boxes or lines."""
    answer: dict[str, Any] = browser.run(GEOMETRY)
    assert answer["boxes"]
    assert answer["lines"]
    found: list[str] = answer["found"]
    return found


def test_what_is_chosen_is_marked_in_graph_and_table(browser: Browser, tmp_path: Path) -> None:
    with fleet(browser, tmp_path, 30):
        click(browser, "#rows tr", "/gripper/")
        (name,) = texts(browser, MARKED_ROWS)
        (line,) = texts(browser, MARKED_LINES)
        assert line.startswith(name)
        assert name in browser.run(DETAILS)
        browser.press("\ue00c")
        assert not browser.run(DETAILS)
        assert not texts(browser, MARKED_ROWS)
        click(browser, "#boxes .line", "BROKEN")
        assert "/teleop/" in texts(browser, MARKED_ROWS)[0]
        assert "/teleop/" in texts(browser, MARKED_FINDINGS)[0]
        click(browser, "#node-rows tr", "/battery/")
        assert "/battery/" in texts(browser, MARKED_BOXES)[0]
        marked = len(texts(browser, MARKED_ROWS))
        assert marked == len(texts(browser, MARKED_LINES)) == 2
        click(browser, "#boxes .proxy", "domain-7")
        assert len(texts(browser, MARKED_ROWS)) == 10, "not all links of the proxy are marked"


@pytest.mark.parametrize(
    ("wanted", "count"),
    [("172.18.0.2", 11), ("domain-7", 11), ("domain 0", 11), ("/arm/driver", 5)],
)
def test_the_filter_finds_hosts_proxies_and_domains(
    browser: Browser, tmp_path: Path, wanted: str, count: int
) -> None:
    with fleet(browser, tmp_path, 30):
        browser.run("document.querySelector('#filter').focus()")
        browser.press(wanted)
        wait_until("the page shows only the wanted rows", lambda: browser.run(ROWS) == count)


def test_an_address_shows_the_same_again(browser: Browser, tmp_path: Path) -> None:
    with fleet(browser, tmp_path, 100):
        browser.run("document.querySelector('#filter').focus()")
        browser.press("172.18.0.3")
        click(browser, "#boxes .group", "172.18.0.3")
        click(browser, "#boxes .node", "/arm/")
        shown = browser.run(SHOWN)
        assert shown["marked"]
        address = browser.run("return location.href")
        browser.open("about:blank")
        browser.open(address)
        wait_until("the page shows the same state", lambda: browser.run(SHOWN) == shown)


def places(browser: Browser, folder: Path, nodes: list[dict[str, str]], *turned: str) -> Any:
    """The boxes of the lane inside for made-up ``nodes``. The groups ``turned`` are unfolded."""
    with made_up(browser, folder, 10):
        return browser.run(PICTURE, nodes, [[key, True] for key in turned])[2]


def inside(*addresses: str, **more: str) -> list[dict[str, str]]:
    """Nodes inside with these addresses. ``more``: further fields of each node."""
    return [{"lane": "container", "address": address, **more} for address in addresses]


def test_few_nodes_are_all_shown_by_container(browser: Browser, tmp_path: Path) -> None:
    nodes = inside("172.18.0.10:1", "172.18.0.9:1", "172.18.0.10:2")
    nodes += inside("172.18.0.11:1", "172.18.0.11:2", "172.18.0.12:1", place="camera")
    assert places(browser, tmp_path, nodes) == [
        "/n1, 172.18.0.9",
        "172.18.0.10, 2 nodes",
        "  /n0, ",
        "  /n2, ",
        "camera, 2 nodes",
        "  /n3, ",
        "  /n4, ",
        "/n5, camera",
    ]


def test_many_nodes_are_folded_by_container(browser: Browser, tmp_path: Path) -> None:
    nodes = [one for n in range(9) for one in inside(*[f"172.18.0.{n}:1"] * 4)]
    nodes[5]["state"] = "broken"
    shown = places(browser, tmp_path, nodes, "container  172.18.0.2")
    assert shown[:3] == [
        "172.18.0.0, 4 nodes",
        "172.18.0.1, 4 nodes, 1 wrong",
        "172.18.0.2, 4 nodes",
    ]
    assert shown[3:7] == [f"  /n{n}, " for n in range(8, 12)]
    assert len(shown) == 9 + 4


def test_a_node_that_comes_and_goes_turns_no_group(browser: Browser, tmp_path: Path) -> None:
    with made_up(browser, tmp_path, 10):
        assert browser.run(FOLDS, [26, 27, 26, 21, 20, 26]) == [30, 4, 4, 4, 24, 30]


def test_of_very_many_containers_some_are_shown(browser: Browser, tmp_path: Path) -> None:
    nodes = inside(*(f"172.18.{n // 200}.{n % 200}:1" for n in range(300)))
    nodes[250]["state"] = "broken"
    shown = places(browser, tmp_path, nodes)
    assert len(shown) == 24
    assert "/n250, 172.18.1.50" in shown, "the broken node is not shown"
    assert shown[-1] == "277 more containers, 277 nodes"


def test_each_of_several_proxies_has_places(browser: Browser, tmp_path: Path) -> None:
    nodes = [
        *inside(*(f"172.18.0.{n}:1" for n in range(100)), proxy="one"),
        *inside("172.19.0.1:1", proxy="two"),
    ]
    shown = places(browser, tmp_path, nodes)
    assert shown[-2:] == ["89 more containers, 89 nodes, of one", "/n100, 172.19.0.1 of two"]
