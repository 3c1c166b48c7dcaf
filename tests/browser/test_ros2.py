"""Tests ROS 2 on the live page in Chromium: real rclpy (Fast DDS) and Cyclone DDS."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from tests.browser.page import (
    CHOOSE,
    NODES,
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
from tests.ros.processes import wait_until
from tests.ros.topology import Topology, remove_leftovers, run_command
from tests.ros2.lab import Lab
from tests.ros2.machines import PLAN, PORTS, built

FIREWALL = """
table ip firewall {{
  chain before {{
    type filter hook prerouting priority raw
    iifname "out0" udp dport {{ {first}-{last} }} drop
  }}
}}
"""


@pytest.fixture(scope="module")
def topology(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Topology]:
    """The machines and networks of the tests."""
    remove_leftovers()
    with built(PLAN, tmp_path_factory.mktemp("machines")) as topology:
        yield topology


@pytest.fixture
def lab(topology: Topology, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    """A lab with a new proxy for ROS 2."""
    lab = Lab(topology, tmp_path_factory.mktemp("lab"))
    with lab.used():
        lab.start_proxy()
        yield lab


def label(lab: Lab, role: str, topic: str) -> str:
    """Wait for the participant on a machine that has a topic, and return the label.

    The label of a ROS node is its name, which the page learns after the topic.
    """
    labels: list[str] = []

    def is_there() -> bool:
        domain = lab.domain()
        vendors = {
            f"{domain.domain} {p.guid_prefix}": p.vendor
            for p in (*domain.inside, *domain.outside)
            if p.address == lab.place(role).address and topic in (*p.publishes, *p.subscribes)
        }
        nodes = lab.page()["nodes"]
        labels[:] = [
            nodes[key]["label"]
            for key, vendor in vendors.items()
            if key in nodes and (vendor != "Fast DDS" or nodes[key]["label"].startswith("/"))
        ]
        return bool(labels)

    wait_until(f"{topic} of {role} is known", is_there)
    (only,) = labels
    return only


@contextmanager
def firewall(lab: Lab) -> Iterator[None]:
    """Have the host drop datagrams to all ports of the range but the first.

    Outside participants send their announcements to the first port.
    """
    enter = ("ip", "netns", "exec", lab.place("host").namespace)
    rules = FIREWALL.format(first=PORTS.first + 1, last=PORTS.last)
    run_command(*enter, "nft", "-f", "-", text=rules)
    try:
        yield
    finally:
        run_command(*enter, "nft", "delete", "table", "ip", "firewall")


def test_participants_and_their_topics(lab: Lab, browser: Browser) -> None:
    lab.node("jazzy", "c1", "pub,serve", topic="/chatter")
    lab.node("cyclone", "c2", "sub", topic="/scan")
    lab.node("jazzy", "out", "pub", topic="/scan")
    lab.node("jazzy", "out", "sub", topic="/chatter").wait_for("^got ")
    talker = label(lab, "c1", "/chatter")
    listener = label(lab, "out", "/chatter")
    reader = label(lab, "c2", "/scan")
    scanner = label(lab, "out", "/scan")
    browser.open(URL)
    outwards = row(browser, "/chatter", State="ok", From=talker, To=listener)
    assert (outwards["Carried by"], outwards["Port"]) == ("direct", UNKNOWN)
    inwards = row(
        browser, "/scan", State="ok", From=scanner, To=reader, **{"Last message": "just now"}
    )
    assert inwards["Carried by"] == "copy"
    # The first rate comes up to four seconds after the first datagram.
    wait_until(
        "datagrams are counted",
        lambda: re.fullmatch(r"[1-9][\d.]* datagrams/s", row(browser, "/scan")["Hz"]),
    )
    assert (outwards["Hz"], outwards["MB/s"]) == (UNKNOWN, UNKNOWN), "the data passes no proxy"
    row(browser, "/chatter (service)", State="ok", From=talker, To=UNKNOWN)
    ok = colour(browser, "ok")
    for ends in ((talker, listener), (scanner, reader)):
        drawn = line(browser, *ends)
        assert drawn["colour"] == ok
        assert re.match(r"/(chatter|scan)\n", drawn["label"]), "the line shows several links"
    assert line(browser, talker, listener)["flow"] == "uncounted"
    assert line(browser, scanner, reader)["flow"] == "flows"
    assert talker.startswith("/pub_serve"), "a name of a node, and no GUID prefix"
    assert reader == lab.place("c2").address, "the program is no ROS node"
    nodes = {cells[1].removesuffix(" (participant)"): cells for cells in browser.run(NODES)}
    for name, where, vendor in (
        (talker, "container, inside", "Fast DDS"),
        (reader, "container, inside", "Cyclone DDS"),
        (listener, "robot, outside", "Fast DDS"),
    ):
        assert nodes[name][0] == "ok"
        assert nodes[name][2] == where
        assert vendor in nodes[name][3]
    assert inwards["Port"] in nodes[reader][4].split(", ")
    places = browser.run(PLACES)
    assert places[listener] < places["rosproxy"] < places[talker], "the boxes are not in the lanes"
    assert trouble(browser) == "Nothing wrong was found."
    quiet = {"ros_discovery_info", "/rosout", "/parameter_events"}
    assert not quiet & {shown["Name"] for shown in rows(browser)}
    browser.run("document.querySelector('#quiet').click()")
    row(browser, "ros_discovery_info", State="ok", From=talker, To=listener)


def test_a_line_is_dashed_once_the_publisher_sends_nothing(lab: Lab, browser: Browser) -> None:
    lab.node("jazzy", "c1", "sub", name="reader", topic="/scan")
    publisher = lab.node("jazzy", "out", "pub", name="scanner", topic="/scan")
    ends = {"From": "/scanner", "To": "/reader"}
    browser.open(URL)
    row(browser, "/scan", **ends, **{"Last message": "just now"})
    assert line(browser, "/scanner", "/reader")["flow"] == "flows"
    publisher.stop()
    wait_until("the publisher has gone", lambda: not rows(browser))
    lab.node("jazzy", "out", "pub", name="scanner", topic="/scan", period=1000)
    silent = row(browser, "/scan", **ends, **{"Hz": "0 datagrams/s", "MB/s": "0"})
    wait_until(
        "the line is dashed", lambda: line(browser, "/scanner", "/reader")["flow"] == "still"
    )
    assert silent["Port"] != UNKNOWN
    assert row(browser, "/scan")["Last message"].endswith(" ago")


def test_qos_that_does_not_match_is_red_at_its_pair_and_green_when_mended(
    lab: Lab, browser: Browser
) -> None:
    lab.node("cyclone", "c2", "sub", topic="/scan")
    lab.node("jazzy", "c1", "sub", topic="/scan", best_effort=True)
    hasty = lab.node("jazzy", "out", "pub", topic="/scan", best_effort=True)
    reader = label(lab, "c2", "/scan")
    other = label(lab, "c1", "/scan")
    scanner = label(lab, "out", "/scan")
    browser.open(URL)
    fix = "make the publisher RELIABLE, or the subscription BEST_EFFORT"
    broken = row(browser, "/scan", State="BROKEN", From=scanner, To=reader, fix=fix)
    assert broken["text"].startswith("reliability differs: the publisher ")
    assert broken["Carried by"] == UNKNOWN
    assert broken["colour"].replace(" ", "") == colour(browser, "broken")
    row(browser, "/scan", State="ok", From=scanner, To=other)
    red = line(browser, scanner, reader)
    assert red["colour"] == colour(browser, "broken")
    assert red["label"] == f"BROKEN: /scan\n{fix}"
    assert fix in browser.run(CHOOSE, scanner, reader)
    told = trouble(browser)
    assert told.startswith(f"BROKEN: /scan from {scanner} to {reader}\n"), (
        "the page shows another finding first"
    )
    assert told.count(fix) == 1
    assert title(browser) == "(1 broken) rosproxy"

    hasty.stop()
    lab.node("jazzy", "out", "pub", topic="/scan")
    row(browser, "/scan", State="ok", To=reader)
    assert line(browser, label(lab, "out", "/scan"), reader)["colour"] == colour(browser, "ok")
    wait_until("nothing is wrong", lambda: title(browser) == "rosproxy")
    assert fix not in trouble(browser)


def test_a_service_of_another_type_is_broken_between_its_ends(lab: Lab, browser: Browser) -> None:
    lab.node("jazzy", "c1", "serve", name="server", topic="/add")
    client = lab.node("jazzy", "out", "call", topic="/server/get_parameters")
    lab.wait_for_participants(1, 1)
    browser.open(URL)
    service = "/server/get_parameters (service)"
    broken = row(browser, service, State="BROKEN")
    assert broken["text"].startswith("type differs: ")
    assert broken["fix"].startswith("use the same type in both programs")
    assert line(browser, broken["From"], broken["To"])["colour"] == colour(browser, "broken")
    assert node_rows(browser, f"{broken['From']} (participant)")[0][2] == "container, inside"
    assert node_rows(browser, f"{broken['To']} (participant)")[0][2] == "robot, outside"
    client.stop()
    wait_until("nothing is broken", lambda: title(browser) == "rosproxy")
    assert service not in {shown["Name"] for shown in rows(browser)}, (
        "the page shows a quiet service"
    )


def test_a_firewall_before_the_range_is_a_warning_until_it_is_gone(
    lab: Lab, browser: Browser
) -> None:
    lab.node("jazzy", "c1", "sub", topic="/scan").wait_for("^ready")
    lab.wait_for_participants(1, 0)
    browser.open(URL)
    with firewall(lab):
        lab.node("jazzy", "out", "pub", topic="/scan")
        lab.wait_for_participants(1, 1)
        wait_until("the page shows the warning", lambda: trouble(browser).startswith("warning: "))
        (outsider,) = lab.domain().outside
        text = f"at {outsider.address} (Fast DDS, outside): no datagram from this"
        fix = "publish the range for UDP, and let firewalls accept UDP"
        assert text in trouble(browser)
        assert fix in trouble(browser)
        (warned,) = (cells for cells in browser.run(NODES) if cells[0] == "warning")
        assert warned[2] == "robot, outside"
        assert text in warned[-1]
        assert fix in warned[-1]
        name = warned[1].removesuffix(" (participant)")
        assert box_colour(browser, name) == colour(browser, "warning")
    shown = row(browser, "/scan", State="ok", From=name)
    wait_until("nothing is wrong", lambda: trouble(browser) == "Nothing wrong was found.")
    assert box_colour(browser, name) == colour(browser, "ok")
    assert line(browser, name, shown["To"])["colour"] == colour(browser, "ok")
