"""Tests rmw_zenoh on the live page in Chromium: sessions with the defaults of rmw_zenoh."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.browser.page import (
    CHOOSE,
    DETAILS,
    PLACES,
    UNKNOWN,
    URL,
    box_colour,
    colour,
    line,
    node_rows,
    row,
    rows,
    title,
    trouble,
)
from tests.browser.webdriver import Browser
from tests.ros.processes import Process, wait_until
from tests.ros.topology import Place, Topology, remove_leftovers
from tests.zenoh.lab import PLAN, PORTS, ROUTER_PORT, Lab

VERSION = "1.6.2"
NUMBER = "std_msgs::msg::dds_::Int32_"
ROUTER = f"{PLAN.robot}:{ROUTER_PORT}"
"""The label of the robot's router."""
NOTHING_WRONG = "Nothing wrong was found."
CHOOSE_BOX = """
[...document.querySelectorAll("#boxes .box:not(.line)")].find((box) =>
  box.title.split("\\n")[0] === arguments[0]).click();
"""


@pytest.fixture(scope="module")
def topology() -> Iterator[Topology]:
    """The machines and networks of the tests."""
    remove_leftovers()
    topology = Topology(PLAN)
    try:
        topology.build()
        yield topology
    finally:
        topology.remove()


@pytest.fixture
def lab(topology: Topology, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    """A lab with a new proxy for rmw_zenoh. Each container has a port of its own."""
    lab = Lab(topology, tmp_path_factory.mktemp("lab"))
    with lab.used():
        for role in PORTS:
            lab.redirect(role)
        lab.start_proxy()
        yield lab


@pytest.fixture
def machine(lab: Lab) -> Place:
    """The machine of the browser, which is also the machine of the proxy."""
    return lab.topology.places["px"]


def started(lab: Lab, role: str, kind: str, **environment: str) -> str:
    """Start a node, and return its label."""
    return label(lab.node(VERSION, role, kind, **environment))


def label(node: Process) -> str:
    return f"/{node.title}"


def test_nodes_and_their_topics(lab: Lab, browser: Browser) -> None:
    lab.start_router(VERSION)
    lab.wait_for_link()
    talker = started(lab, "c1", "pub")
    server = started(lab, "c1", "serve")
    neighbour = started(lab, "c2", "sub")
    listener = started(lab, "out", "sub")
    client = started(lab, "out", "call")
    browser.open(URL)
    outwards = row(browser, "/chatter", State="ok", From=talker, To=listener)
    assert (outwards["Carried by"], outwards["Port"]) == ("router", str(PORTS["c1"]))
    assert {outwards[head] for head in ("Hz", "MB/s", "Last message")} == {UNKNOWN}
    across = row(browser, "/chatter", State="ok", From=talker, To=neighbour)
    assert (across["Carried by"], across["Port"]) == ("router", str(PORTS["c2"]))
    row(browser, "/chatter (service)", State="ok", From=server, To=client)
    drawn = line(browser, talker, listener)
    assert drawn["colour"] == colour(browser, "ok")
    assert drawn["flow"] == "uncounted"
    assert "std_msgs/msg/String" in browser.run(CHOOSE, talker, listener)
    (cells,) = node_rows(browser, f"{talker} (zenoh node)")
    address = lab.topology.places["c1"].address
    assert cells[:5] == ["ok", cells[1], "container, inside", address, str(PORTS["c1"])]
    (cells,) = node_rows(browser, f"{listener} (zenoh node)")
    assert cells[2:4] == ["robot, outside", f"{ROUTER}, behind this router"]
    (cells,) = node_rows(browser, f"{ROUTER} (router)")
    assert cells[0] == "ok"
    places = browser.run(PLACES)
    assert places[listener] < places["rosproxy"] < places[talker], "the boxes are not in the lanes"
    assert trouble(browser) == NOTHING_WRONG


def test_nodes_appear_and_go(lab: Lab, browser: Browser) -> None:
    lab.start_router(VERSION)
    lab.wait_for_link()
    talker = started(lab, "c1", "pub")
    browser.open(URL)
    alone = row(browser, "/chatter", From=talker, To=UNKNOWN)
    assert alone["text"] == "no subscription is known in domain 0"
    subscriber = lab.node(VERSION, "out", "sub")
    row(browser, "/chatter", State="ok", From=talker, To=label(subscriber))
    subscriber.kill()
    row(browser, "/chatter", From=talker, To=UNKNOWN)
    assert not node_rows(browser, f"{label(subscriber)} (zenoh node)")


def test_a_router_that_is_down_is_red_until_it_runs(lab: Lab, browser: Browser) -> None:
    talker = started(lab, "c1", "pub")
    browser.open(URL)
    alone = row(browser, "/chatter", From=talker, To=UNKNOWN)
    wait_until("the page shows the fault", lambda: title(browser) == "(1 broken) rosproxy", 30)
    assert trouble(browser).startswith(f"BROKEN: {ROUTER}\n")
    assert "ros2 run rmw_zenoh_cpp rmw_zenohd" in trouble(browser)
    assert box_colour(browser, ROUTER) == colour(browser, "broken")
    alone = row(browser, "/chatter", From=talker)
    assert f"No link to {ROUTER}" in alone["text"]
    browser.run(CHOOSE_BOX, ROUTER)
    assert "not linked with the hub of the proxy for " in browser.run(DETAILS)

    lab.start_router(VERSION)
    wait_until("nothing is wrong", lambda: trouble(browser) == NOTHING_WRONG, 30)
    assert box_colour(browser, ROUTER) == colour(browser, "ok")
    listener = started(lab, "out", "sub")
    row(browser, "/chatter", State="ok", From=talker, To=listener)


def test_another_type_is_red_at_its_pair_and_green_when_mended(lab: Lab, browser: Browser) -> None:
    lab.start_router(VERSION)
    lab.wait_for_link()
    talker = started(lab, "c1", "pub")
    other = started(lab, "c2", "sub")
    wrong = lab.node(VERSION, "out", "sub", NODE_TYPE=NUMBER)
    browser.open(URL)
    fix = "use the same type in both programs, or remap the name in one of them"
    broken = row(browser, "/chatter", State="BROKEN", From=talker, To=label(wrong), fix=fix)
    assert broken["text"].startswith(f"type differs: the publisher {talker} (")
    assert broken["Carried by"] == UNKNOWN
    row(browser, "/chatter", State="ok", From=talker, To=other)
    red = line(browser, talker, label(wrong))
    assert red["colour"] == colour(browser, "broken")
    assert red["label"] == f"BROKEN: /chatter\n{fix}"
    told = trouble(browser)
    assert told.startswith(f"BROKEN: /chatter from {talker} to {label(wrong)}\n")
    assert told.count(fix) == 1

    wrong.kill()
    right = started(lab, "out", "sub")
    row(browser, "/chatter", State="ok", From=talker, To=right)
    wait_until("nothing is wrong", lambda: title(browser) == "rosproxy", 30)


def test_a_rule_is_told_at_its_pair_and_is_no_fault(lab: Lab, browser: Browser) -> None:
    lab.start_router(VERSION)
    lab.wait_for_link()
    talker = started(lab, "c1", "pub")
    listener = started(lab, "out", "sub")
    browser.open(URL)
    row(browser, "/chatter", State="ok", From=talker, To=listener)
    lab.post_policy({"name": "operator", "rules": ["deny publish /chatter"]})
    cells = {"State": "not looked at", "From": talker, "To": listener}
    hidden = "hidden from outside by the policy: "
    wait_until(
        "the page names the rule",
        lambda: row(browser, "/chatter", **cells)["text"].startswith(hidden),
    )
    assert trouble(browser) == NOTHING_WRONG
    lab.post_policy()
    row(browser, "/chatter", State="ok", From=talker, To=listener)


def test_two_containers_at_one_port_are_a_warning(lab: Lab, browser: Browser) -> None:
    lab.start_router(VERSION)
    lab.end_redirects()
    proxy = lab.topology.places["px"].address
    override = f'connect/endpoints=["tcp/{proxy}:{PORTS["c1"]}"]'
    talker = started(lab, "c1", "pub", ZENOH_CONFIG_OVERRIDE=override)
    listener = started(lab, "c2", "sub", ZENOH_CONFIG_OVERRIDE=override)
    browser.open(URL)
    warned = row(browser, "/chatter", State="warning", From=talker, To=listener)
    assert "are peers of the same router" in warned["text"]
    assert line(browser, talker, listener)["colour"] == colour(browser, "warning")
    assert trouble(browser).count("are peers of the same router") == 1
    assert all(shown["Name"] == "/chatter" for shown in rows(browser))
