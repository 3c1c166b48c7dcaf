"""Tests the live page during updates: focus, chosen line, announcements, connection.

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
const box = document.activeElement;
return [box.title, box.getAttribute("aria-expanded")];
"""
BREAK = """
const { state } = window.rosproxyPage;
const link = [...state.links].find(([, row]) => row.name === arguments[0])[1];
Object.assign(link, { state: "broken", text: `${link.name} is cut`, fix: arguments[1] });
"""
FINDINGS = """
return [...document.querySelectorAll("#findings li")].map((item) => [
  item.querySelector(".what")?.textContent, item.querySelector(".fix")?.textContent,
  item.seen || false]);
"""
FIXES = ("mend the first", "restart the second")
MARK = "document.querySelectorAll(arguments[0]).forEach((item) => { item.seen = true; });"
SEEN = "return [...document.querySelectorAll(arguments[0])].every((item) => item.seen);"


@pytest.fixture
def machine() -> Place:
    """The machine of page and browser. No test here needs ROS."""
    return THIS_MACHINE


@pytest.fixture
def server(browser: Browser, tmp_path: Path) -> Iterator[Process]:
    """The server of a page with 100 nodes, in namespaces of two or three nodes."""
    with made_up(browser, tmp_path, 100) as server:
        wait_until("the page shows rows", lambda: len(rows(browser)) == 100)
        yield server


@contextmanager
def stopped(server: Process) -> Iterator[None]:
    """Suspend the server. The connections of the server stay open."""
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
    """The filter leaves a single node of the namespace, so this node has a separate box.

    Updates do not replace the elements of the details.
    """
    browser.run("document.querySelector('#filter').focus()")
    browser.press("node3/")
    wait_until("the page shows only two rows", lambda: len(rows(browser)) == 2)
    told = "/group3/node3/topic0"
    wait_until(
        "the details show the line",
        lambda: told in browser.run(CHOOSE, "/group3/node3", "/outside3"),
        20,
    )
    wait_until("the rate is known", lambda: "in the last minute" in browser.run(DETAILS))
    browser.run(MARK, "#details *")
    before = browser.run(DETAILS)
    wait_until("rates follow", lambda: browser.run(DETAILS) != before)
    assert browser.run(SEEN, "#details *")


@pytest.mark.usefixtures("server")
def test_what_is_chosen_and_goes_is_chosen_no_more(browser: Browser) -> None:
    browser.run("document.querySelector('#filter').focus()")
    browser.press("node3/")
    wait_until(
        "the details show the line", lambda: browser.run(CHOOSE, "/group3/node3", "/outside3"), 20
    )
    browser.press("x")
    wait_until("the details are empty", lambda: not browser.run(DETAILS))
    browser.press("\ue003")
    wait_until("the page shows both rows again", lambda: len(rows(browser)) == 2)
    assert not browser.run(DETAILS)


def test_a_finding_that_is_there_is_not_said_again(browser: Browser, server: Process) -> None:
    def told(*numbers: int) -> bool:
        """Break the links on the page, and return whether the page shows the findings.

        An update under way may have repaired the links, so each check breaks the links again.
        """
        findings = []
        for number in numbers:
            node = f"/group{number}/node{number}"
            browser.run(BREAK, f"{node}/topic0", FIXES[number])
            what = f"BROKEN: {node}/topic0 from {node} to /outside{number}"
            findings.append([what, FIXES[number]])
        return [[what, fix] for what, fix, _ in browser.run(FINDINGS)] == findings

    with stopped(server):  # the server would send the links without faults
        wait_until("the page shows the first finding", lambda: told(0))
        browser.run(MARK, "#findings li")
        wait_until("the page shows both findings", lambda: told(0, 1))
        assert [seen for _, _, seen in browser.run(FINDINGS)] == [True, False]


@pytest.mark.usefixtures("server")
def test_a_page_in_the_background_follows(browser: Browser) -> None:
    """A page in the background gets no frames. Drawing must not wait for the next frame."""
    browser.run("window.requestAnimationFrame = () => 0")
    before = rates(browser)
    wait_until("rates follow", lambda: rates(browser) != before)


def test_a_connection_that_is_silent_is_made_anew(browser: Browser, server: Process) -> None:
    """A cut connection has no end, so for the browser the connection seems open."""

    def minute_later() -> str:
        """Set the clock a minute ahead, and return the state of the connection.

        An event under way may arrive after that, so each check sets the clock ahead again.
        """
        browser.run("const now = Date.now; Date.now = () => now() + 60000")
        return str(browser.run(CONNECTION))

    assert browser.run(CONNECTION) == "Live"
    with stopped(server):
        wait_until(
            "the page shows that the connection is lost",
            lambda: minute_later().startswith("Not connected"),
        )
    wait_until("the page is connected again", lambda: browser.run(CONNECTION) == "Live")
    before = rates(browser)
    wait_until("rates follow", lambda: rates(browser) != before)
