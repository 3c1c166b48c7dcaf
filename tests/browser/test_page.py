"""The live page in Chromium, with real nodes on both sides of the proxy."""

from __future__ import annotations

import re
import socket
from pathlib import Path

import pytest

from rosproxy.ros1.protocol.tcpros import encode_header
from tests.browser.page import (
    CHOOSE,
    FOCUS_GROUP,
    NODES,
    PLACES,
    UNKNOWN,
    URL,
    colour,
    cut,
    line,
    made_up,
    port_of,
    row,
    rows,
    title,
)
from tests.browser.webdriver import Browser
from tests.ros.lab import Lab
from tests.ros.processes import wait_until
from tests.ros.topology import OUT_HOST

MOST_ROWS = 400
"""Rows that the page shows at once."""
HOSTILE = "/<img src=x onerror=document.title='mine'>"


def talk(lab: Lab, library: str = "roscpp") -> None:
    """Start a publisher inside and a subscriber outside; wait for three messages."""
    lab.node(library, "c1", "pub", name="talker", topic="/chatter", rate=10)
    heard = lab.node(library, "out", "sub", name="listener", topic="/chatter")
    heard.wait_for_count("^got ", 3)


def chosen_line(browser: Browser) -> str:
    """Choose the line from /talker to /listener, and return the details on the page."""
    return str(browser.run(CHOOSE, "/talker", "/listener"))


def test_a_link_that_breaks_turns_red_with_the_command_and_green_when_mended(
    lab: Lab, browser: Browser
) -> None:
    talk(lab)
    port = port_of(lab, "talker")
    browser.open(URL)
    well = row(browser, "/chatter", State="ok", To="/listener", **{"Last message": "just now"})
    assert (well["Carried by"], well["Port"]) == ("splice", str(port))
    assert line(browser, "/talker", "/listener")["colour"] == colour(browser, "ok")
    wait_until(
        "the line shows the rates",
        lambda: re.fullmatch(
            r"/chatter\n[\d.]+ Hz, [\d.<]+ MB/s, splice",
            line(browser, "/talker", "/listener")["label"],
        ),
        60,
    )
    wait_until(
        "the details show the last message, too",
        lambda: "last message just now, carried by splice" in chosen_line(browser),
        60,
    )
    places = browser.run(PLACES)
    assert places["/listener"] < places["rosproxy"] < places["/talker"], (
        "the boxes are not in the lanes"
    )
    used = browser.run("return document.querySelector('#summary').textContent")
    assert re.search(r"ports \d+-\d+: [1-9]\d* used, \d+ free", used)
    with cut(lab, port):
        broken = row(browser, "/chatter", State="BROKEN", To="/listener")
        assert f"on the machine of /listener: nc -vz {OUT_HOST} {port}" in broken["fix"]
        red = line(browser, "/talker", "/listener")
        assert red["colour"] == colour(browser, "broken")
        assert red["label"].startswith("BROKEN: /chatter\n")
        assert f"nc -vz {OUT_HOST} {port}" in red["label"]
        assert f"nc -vz {OUT_HOST} {port}" in chosen_line(browser)
        told = browser.run("return document.querySelector('#findings').textContent")
        assert f"nc -vz {OUT_HOST} {port}" in told
        assert title(browser) == "(1 broken) rosproxy"
    row(browser, "/chatter", State="ok", To="/listener", **{"Last message": "just now"})
    assert line(browser, "/talker", "/listener")["colour"] == colour(browser, "ok")
    assert title(browser) == "rosproxy"


def test_a_pair_that_never_met(lab: Lab, browser: Browser) -> None:
    lab.node("rospy", "c1", "pub", name="talker", topic="/chatter", rate=10)
    lab.wait_registered("talker")
    port = port_of(lab, "talker")
    browser.open(URL)
    with cut(lab, port):
        heard = lab.node("roscpp", "out", "sub", name="listener", topic="/chatter")
        lab.wait_registered("listener")
        broken = row(browser, "/chatter", State="BROKEN", To="/listener")
        assert "has not connected to" in broken["text"]
        assert f"nc -vz {OUT_HOST} {port}" in broken["fix"]
    heard.wait_for("^got ")
    row(browser, "/chatter", State="ok", To="/listener")


def test_hertz_and_bytes_are_those_of_the_nodes(lab: Lab, browser: Browser) -> None:
    talk(lab)
    talk_back = lab.node("rospy", "out", "pub", name="sender", topic="/back", rate=20, size=5000)
    lab.node("rospy", "c2", "sub", name="taker", topic="/back").wait_for_count("^got ", 3)
    browser.open(URL)

    def told() -> set[str]:
        no_rate = (UNKNOWN, "0")
        return {
            topic_row["Name"]
            for topic_row in rows(browser)
            if topic_row["To"] and topic_row["Hz"] not in no_rate
        }

    wait_until("the page shows both rates", lambda: told() >= {"/chatter", "/back"}, 90)
    back = row(browser, "/back", State="ok", To="/taker")
    assert back["Carried by"] == "direct"
    assert back["MB/s"] not in (UNKNOWN, "0")
    talk_back.kill()
    row(browser, "/back", State="BROKEN", To="/taker")


def test_what_every_node_has_is_hidden_until_asked_for(lab: Lab, browser: Browser) -> None:
    talk(lab)
    browser.open(URL)
    row(browser, "/chatter", State="ok", To="/listener")
    assert not {"/rosout"} & {topic_row["Name"] for topic_row in rows(browser)}
    browser.run("document.querySelector('#quiet').focus()")
    browser.press(" ")
    row(browser, "/rosout")
    browser.run("document.querySelector('#filter').focus()")
    browser.press("chatt")
    wait_until(
        "other names are hidden",
        lambda: {topic_row["Name"] for topic_row in rows(browser)} == {"/chatter"},
    )


def test_nodes_of_a_container_are_a_group(lab: Lab, browser: Browser) -> None:
    for name in ("left", "right"):
        lab.node("roscpp", "c1", "pub", name=name, topic=f"/{name}", rate=5)
        lab.wait_registered(f"/{name}")
    browser.open(URL)
    wait_until("each node has a box", lambda: {"/left", "/right"} <= browser.run(PLACES).keys())
    group = lab.place("c1").address
    browser.run(FOCUS_GROUP, group)
    browser.press("\ue007")
    wait_until("the group is one box", lambda: not {"/left", "/right"} & browser.run(PLACES).keys())
    assert group in browser.run(PLACES)


def test_names_are_text_whatever_they_are(lab: Lab, browser: Browser) -> None:
    """The master refuses odd names, but a caller of a node may choose any caller_id."""
    talker = lab.node("roscpp", "c1", "pub", name="talker", topic="/chatter", rate=10)
    talker.wait_for("^sent ")  # a registration alone may be the one for /rosout
    header = {"callerid": HOSTILE, "topic": "/chatter", "md5sum": "*", "type": "*"}
    with lab.place("out").entered():
        stranger = socket.create_connection((OUT_HOST, port_of(lab, "talker")))
    with stranger:
        stranger.sendall(encode_header(header))
        browser.open(URL)
        row(browser, "/chatter", To=HOSTILE)
        assert browser.run("return document.querySelector('img')") is None
        assert "mine" not in title(browser)


def test_light_dark_and_a_phone(lab: Lab, browser: Browser) -> None:
    talk(lab)
    browser.open(URL)
    row(browser, "/chatter", State="ok", To="/listener")
    shades = {}
    for scheme in ("light", "dark"):
        browser.prefer(scheme)
        shades[scheme] = browser.run("return getComputedStyle(document.body).backgroundColor")
        wait_until(
            f"the graph is {scheme}",
            lambda: line(browser, "/talker", "/listener")["colour"] == colour(browser, "ok"),
        )
    assert shades["light"] != shades["dark"]
    browser.resize(360, 740)
    narrow = "return document.documentElement.scrollWidth <= innerWidth"
    wait_until("nothing is wider than a phone", lambda: browser.run(narrow))
    with cut(lab, port_of(lab, "talker")):
        row(browser, "/chatter", State="BROKEN", To="/listener")
        assert browser.run(narrow), "a long command is wider than a phone"


def test_the_keyboard_alone_gets_everywhere(lab: Lab, browser: Browser) -> None:
    talk(lab)
    browser.open(URL)
    row(browser, "/chatter", State="ok", To="/listener")
    focus = "const item = document.activeElement; return item.id || item.className.split(' ')[0]"
    visited: list[str] = []
    while visited.count("scroll") < 2 and len(visited) < 50:
        browser.press("\ue004")
        visited.append(browser.run(focus))
    # A finding of the previous test may still be on the page.
    visited = [name for name in visited if name not in ("cause", "copy")]
    boxes = visited.count("box")
    assert boxes > 3, "fewer boxes than two nodes, a line and the proxy"
    zoom = ["zoom-less", "zoom-more", "zoom-fit"]
    before = ["skip", "wrong", "past", "filter", "quiet", "unfold", *zoom, "graph"]
    assert visited == [*before, *["box"] * boxes, "scroll", "scroll"], (
        "the order of the focus is wrong"
    )


def test_a_thousand_nodes(lab: Lab, browser: Browser, tmp_path: Path) -> None:
    """The nodes are made up. The page shows MOST_ROWS links, and the number of further links."""
    with made_up(browser, tmp_path, 1000, place=lab.place("px")):
        wait_until("the page shows rows", lambda: len(rows(browser)) == MOST_ROWS, 60)
        told = browser.run("return document.querySelector('#more').textContent")
        assert told == "600 more: narrow it down by a name."
        before = [page_row["MB/s"] for page_row in rows(browser)]
        wait_until(
            "the page updates the rates",
            lambda: before != [page_row["MB/s"] for page_row in rows(browser)],
            60,
        )
        browser.run("document.querySelector('#filter').focus()")
        browser.press("node499/")
        wait_until("the page shows only two rows", lambda: len(rows(browser)) == 2, 60)


@pytest.mark.parametrize("width", [1200, 360])
def test_a_screen_reader_finds_it_all(lab: Lab, browser: Browser, width: int) -> None:
    talk(lab)
    browser.resize(width, 740)
    browser.open(URL)
    row(browser, "/chatter", State="ok", To="/listener")
    nodes = browser.devtools("Accessibility.getFullAXTree")["nodes"]
    told = {(node["role"]["value"], node.get("name", {}).get("value", "")) for node in nodes}
    roles = {role for role, _ in told}
    assert {"table", "row", "status", "searchbox", "checkbox", "heading"} <= roles
    assert {("columnheader", "Carried by"), ("columnheader", "Ports")} <= told
    assert {("cell", "/chatter"), ("cell", "container, inside")} <= told
    unnamed = {
        role for role, name in told if role in ("button", "searchbox", "checkbox") and not name
    }
    assert not unnamed


def test_nodes_with_their_addresses_and_ports(lab: Lab, browser: Browser) -> None:
    talk(lab)
    browser.open(URL)
    row(browser, "/chatter", State="ok", To="/listener")
    nodes = {cells[1]: cells for cells in browser.run(NODES)}
    state, _, where, address, ports, *_ = nodes["/talker"]
    assert (state, where) == ("ok", "container, inside")
    assert re.match(r"[\d.]+:\d+$", address)
    assert str(port_of(lab, "talker")) in ports
    assert nodes["/listener"][2] == "robot, outside"
    assert "/rosout" not in nodes
    browser.run("document.querySelector('#filter').focus()")
    browser.press("talk")
    wait_until(
        "the page shows only /talker",
        lambda: [cells[1] for cells in browser.run(NODES)] == ["/talker"],
    )
