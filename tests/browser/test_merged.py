"""Tests the live page of an operator in Chromium, with two running proxies.

Each proxy has a separate inside network, and both use the same master outside. c1 is behind px, c2
behind px2.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from tests.browser.page import (
    CHOOSE,
    box_colour,
    colour,
    line,
    node_rows,
    row,
    rows,
    serving,
    title,
    trouble,
)
from tests.browser.webdriver import Browser
from tests.ros.cpp import compiled_node
from tests.ros.forks import Forks
from tests.ros.lab import ADMIN_PORT, MASTER_URI, Lab
from tests.ros.processes import Process, stop_all, wait_until
from tests.ros.topology import (
    OUT_HOST,
    SPLIT,
    Place,
    PortMap,
    SecondProxy,
    Topology,
    remove_leftovers,
)

PORTS = PortMap(47000, 47029, 47000)
PLAN = replace(SPLIT, name="m", hairpin=True, second=SecondProxy((2,), PORTS))
TOKEN = "0123456789abcdef"
ADMIN = ("--admin-bind", f"0.0.0.0:{ADMIN_PORT}", "--admin-token", TOKEN)
OPERATOR_PORT = 11313
PORTS_OF_FIRST = re.compile(r"460[0-2]\d")
"""Ports of the first proxy, as the host publishes these ports."""


class Second:
    """The proxy on px2."""

    def __init__(self, lab: Lab) -> None:
        self._lab = lab
        self.process = self._start()

    def _start(self) -> Process:
        argv = [sys.executable, "-m", "rosproxy", "run", "--master-uri", MASTER_URI]
        argv += ["--advertise-host", OUT_HOST, "--port-range", PORTS.bound, *ADMIN]
        process = self._lab.spawn_proxy("px2", argv)
        process.wait_for("listening: ")
        return process

    def start_again(self) -> None:
        """Start the proxy after a kill."""
        self.process = self._start()


@pytest.fixture
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    """A lab with a master outside and the proxy on px."""
    remove_leftovers()
    compiled_node()
    topology = Topology(PLAN)
    forks = Forks()
    topology.build()
    lab = Lab(topology, tmp_path_factory.mktemp("lab"), forks)
    lab.proxy_options = ADMIN
    try:
        lab.ensure_running()
        yield lab
        lab.check_proxy()
    finally:
        lab.stop()
        forks.stop()
        topology.remove()


@pytest.fixture
def second(lab: Lab) -> Iterator[Second]:
    """The proxy on px2."""
    second = Second(lab)
    yield second
    stop_all([second.process])
    assert "Traceback" not in second.process.output(), second.process.output()


@pytest.fixture
def machine(lab: Lab) -> Place:
    """The machine of operator and browser: the host, which is on the networks of both proxies."""
    return lab.place("host")


@pytest.fixture
def operator(
    lab: Lab, second: Second, machine: Place, browser: Browser, tmp_path: Path
) -> Iterator[Process]:
    """The operator, with the page open in the browser. The proxies are named `one` and `two`."""
    addresses = {"one": lab.place("px").address, "two": lab.place("px2").address}
    places = {lab.place(name).address: f"box-{name}" for name in ("c1", "c2")}
    words = ["tests.browser.merged", TOKEN, json.dumps(places)]
    words += [f"{name}={address}:{ADMIN_PORT}" for name, address in addresses.items()]
    with serving(browser, machine, tmp_path / "operator.log", OPERATOR_PORT, *words) as server:
        yield server
    assert "Traceback" not in server.output(), server.output()


def hearers(browser: Browser) -> list[str]:
    """The subscribers of /chatter, by the rows of the links."""
    return sorted(link["To"] for link in rows(browser) if link["Name"] == "/chatter")


@pytest.mark.usefixtures("operator")
def test_two_proxies_one_of_which_is_killed(lab: Lab, second: Second, browser: Browser) -> None:
    lab.node("roscpp", "c1", "pub", name="talker", topic="/chatter", rate=10)
    for role, name in (("out", "listener"), ("c2", "hearer")):
        lab.node("roscpp", role, "sub", name=name, topic="/chatter").wait_for("^got ")
    for listener in ("/listener", "/hearer"):
        shown = row(browser, "/chatter", State="ok", From="/talker", To=listener)
        assert PORTS_OF_FIRST.fullmatch(shown["Port"]), shown
    wait_until(
        "the page shows each link once", lambda: hearers(browser) == ["/hearer", "/listener"]
    )
    for name, where in (
        ("/talker", "box-c1, inside of one"),
        ("/hearer", "box-c2, inside of two"),
        ("/listener", "robot, outside"),
        ("master (master)", "robot, outside"),
    ):
        assert [cells[2] for cells in node_rows(browser, name)] == [where]
    ok = colour(browser, "ok")
    red = colour(browser, "broken")
    assert box_colour(browser, "two") == ok
    assert line(browser, "/talker", "/hearer")["colour"] == ok
    told = "/chatter from /talker at box-c1 to /hearer at box-c2"
    assert told in browser.run(CHOOSE, "/talker", "/hearer")

    second.process.kill()
    wait_until("the page shows proxy two as broken", lambda: "BROKEN: two\n" in trouble(browser))
    (broken,) = node_rows(browser, "two (proxy)")
    admin = f"{lab.place('px2').address}:{ADMIN_PORT}"
    assert broken[0] == "BROKEN"
    assert broken[-1] == f"no data from this proxy: {admin} refuses connectionsdocker logs two"
    assert "docker logs two" in trouble(browser)
    assert box_colour(browser, "two") == red
    assert title(browser) == "(1 broken) rosproxy"
    assert node_rows(browser, "one (proxy)")[0][0] == "ok"
    assert node_rows(browser, "/talker")[0][2] == "box-c1, inside of one"

    second.start_again()
    wait_until("nothing is broken", lambda: title(browser) == "rosproxy")
    assert node_rows(browser, "two (proxy)")[0][0] == "ok"
    assert box_colour(browser, "two") == ok
    events = browser.run("return document.querySelector('#events').textContent")
    assert "proxy two: gone for " in events
    row(browser, "/chatter", State="ok", From="/talker", To="/hearer")
    wait_until(
        "/hearer is back behind proxy two",
        lambda: [c[2] for c in node_rows(browser, "/hearer")] == ["box-c2, inside of two"],
    )
