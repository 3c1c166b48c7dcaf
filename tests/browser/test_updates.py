"""The state of the live page during updates: focus, chosen line, announcements, connection.

The nodes are made up (`tests.browser.many`).
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.browser.page import CHOOSE, DETAILS, FOCUS_GROUP, THIS_MACHINE, made_up, rows
from tests.browser.webdriver import Browser
from tests.ros.processes import Process, wait_until
from tests.ros.topology import Place

CONNECTION = "return document.querySelector('#connection').textContent"
FOCUS = """
const one = document.activeElement;
return [one.title, one.getAttribute("aria-expanded")];
"""
BREAK = """
const { state } = window.rosproxyPage;
const link = [...state.links].find(([, one]) => one.name === arguments[0])[1];
Object.assign(link, { state: "broken", text: `${link.name} is cut`, fix: arguments[1] });
"""
FINDINGS = """
return [...document.querySelectorAll("#findings li")].map((one) => [
  one.querySelector(".what")?.textContent, one.querySelector(".fix")?.textContent,
  one.seen || false]);
"""
FIXES = ("mend the first", "restart the second")
MARK = "document.querySelectorAll(arguments[0]).forEach((one) => { one.seen = true; });"
SEEN = "return [...document.querySelectorAll(arguments[0])].every((one) => one.seen);"


@pytest.fixture
def machine() -> Place:
    """Where page and browser are: no test here needs ROS."""
    return THIS_MACHINE


@pytest.fixture
def server(browser: Browser, tmp_path: Path) -> Iterator[Process]:
    """The page of some nodes, in namespaces of two or three."""
    with made_up(browser, tmp_path, 100) as server:
        wait_until("there are rows", lambda: len(rows(browser)) == 100)
        yield server


@contextmanager
def stopped(server: Process) -> Iterator[None]:
    """It does nothing, and its connections stand."""
    os.kill(server.pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(server.pid, signal.SIGCONT)


def rates(browser: Browser) -> list[str]:
    return [page_row["MB/s"] for page_row in rows(browser)]


@pytest.mark.usefixtures("server")
def test_a_namespace_keeps_the_focus(browser: Browser) -> None:
    name = "/group0\n3 nodes"
    browser.run(FOCUS_GROUP, name)
    assert browser.run(FOCUS) == [name, "false"]
    browser.press("\ue007")
    assert browser.run(FOCUS) == [name, "true"]
    browser.press("\ue007")
    assert browser.run(FOCUS) == [name, "false"]


@pytest.mark.usefixtures("server")
def test_what_is_chosen_is_told_where_the_rest_is_hidden(browser: Browser) -> None:
    """Alone of its namespace it has a box of its own; and what is marked in the text stays so."""
    browser.run("document.querySelector('#filter').focus()")
    browser.press("node3/")
    wait_until("two are left", lambda: len(rows(browser)) == 2)
    told = "/group3/node3/topic0"
    wait_until("it is drawn", lambda: told in browser.run(CHOOSE, "/group3/node3", "/outside3"), 20)
    browser.run(MARK, "#details *")
    before = browser.run(DETAILS)
    wait_until("rates follow", lambda: browser.run(DETAILS) != before)
    assert browser.run(SEEN, "#details *")


@pytest.mark.usefixtures("server")
def test_what_is_chosen_and_goes_is_chosen_no_more(browser: Browser) -> None:
    browser.run("document.querySelector('#filter').focus()")
    browser.press("node3/")
    wait_until("it is drawn", lambda: browser.run(CHOOSE, "/group3/node3", "/outside3"), 20)
    browser.press("x")
    wait_until("it is gone", lambda: not browser.run(DETAILS))
    browser.press("\ue003")
    wait_until("it is back", lambda: len(rows(browser)) == 2)
    assert not browser.run(DETAILS)


def test_a_finding_that_is_there_is_not_said_again(browser: Browser, server: Process) -> None:
    def told(*numbers: int) -> bool:
        """Break the links; what was on its way to the browser may have mended them again."""
        findings = []
        for number in numbers:
            node = f"/group{number}/node{number}"
            browser.run(BREAK, f"{node}/topic0", FIXES[number])
            what = f"BROKEN: {node}/topic0 from {node} to /outside{number}"
            findings.append([what, FIXES[number]])
        return [[what, fix] for what, fix, _ in browser.run(FINDINGS)] == findings

    with stopped(server):  # it would send the links anew, as they are there
        wait_until("the first is told", lambda: told(0))
        browser.run(MARK, "#findings li")
        wait_until("both are told", lambda: told(0, 1))
        assert [seen for _, _, seen in browser.run(FINDINGS)] == [True, False]


@pytest.mark.usefixtures("server")
def test_a_page_in_the_background_follows(browser: Browser) -> None:
    """It gets no frames, and what it is to draw does not queue up for the next one."""
    browser.run("window.requestAnimationFrame = () => 0")
    before = rates(browser)
    wait_until("rates follow", lambda: rates(browser) != before)


def test_a_connection_that_is_silent_is_made_anew(browser: Browser, server: Process) -> None:
    """Cut off without an end: to the browser it seems open."""

    def minute_later() -> str:
        """What was on its way to the browser may have come after that minute."""
        browser.run("const now = Date.now; Date.now = () => now() + 60000")
        return str(browser.run(CONNECTION))

    assert browser.run(CONNECTION) == "Live"
    with stopped(server):
        wait_until("it says so", lambda: minute_later().startswith("Not connected"))
    wait_until("it is back", lambda: browser.run(CONNECTION) == "Live")
    before = rates(browser)
    wait_until("rates follow", lambda: rates(browser) != before)
