"""Reads the live page in a browser as a user sees the tables and the graph, and serves pages."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from examples.demo.proxy_process import clean_environment
from tests.browser.webdriver import Browser, Json
from tests.ros.lab import ADMIN_PORT, Lab
from tests.ros.processes import Process, wait_until
from tests.ros.topology import Place, run_command

UNKNOWN = "\N{EN DASH}"
MANY_PORT = 21312
"""The port of the page with made-up nodes."""
URL = f"http://127.0.0.1:{ADMIN_PORT}/"
ROWS = """
return [...document.querySelectorAll("#rows tr")].map((row) => ({
  ...Object.fromEntries([...row.cells].slice(0, 9)
    .map((cell) => [cell.dataset.head, cell.textContent])),
  text: row.lastChild.firstChild.textContent, fix: row.lastChild.querySelector(".fix").textContent,
  colour: getComputedStyle(row.cells[0]).color }));
"""
NODES = """
const textOf = (cell) => [...cell.childNodes].map((child) =>
  child.className === "copies" ? "" : child.textContent).join("");
return [...document.querySelectorAll("#node-rows tr")].map((row) => [...row.cells].map(textOf));
"""
LINE = """
const row = [...document.querySelectorAll("#boxes .line")].find((line) =>
  line.dataset.from === arguments[0] && line.dataset.to === arguments[1]);
if (!row) return null;
const ways = [...document.querySelectorAll("#lines g")];
const way = ways.find((group) => group.dataset.id === row.dataset.id);
return { colour: getComputedStyle(way).color, flow: way.getAttribute("class").split(" ")[1],
  label: [...row.children].map((child) => child.textContent).filter(Boolean).join("\\n") };
"""
CHOOSE = """
const row = [...document.querySelectorAll("#boxes .line")].find((line) =>
  line.dataset.from === arguments[0] && line.dataset.to === arguments[1]);
if (row && !row.hasAttribute("aria-current")) row.click();
return document.querySelector("#details").textContent;
"""
PLACES = """
return Object.fromEntries([...document.querySelectorAll("#boxes .box")].map((box) =>
  [box.title.split("\\n")[0], box.getBoundingClientRect().left]));
"""
BOX = """
const box = [...document.querySelectorAll("#boxes .box:not(.line)")].find((node) =>
  node.title.split("\\n")[0] === arguments[0]);
return box ? getComputedStyle(box).borderTopColor : "";
"""
DETAILS = "return document.querySelector('#details').textContent"
FOCUS_GROUP = """
const groups = [...document.querySelectorAll("#boxes .group")];
groups.find((group) => group.title.startsWith(arguments[0])).focus();
"""
TROUBLE = "return document.querySelector('#findings').innerText"
TITLE = "return document.title"
CUT = """
table ip cut {{
  chain forward {{
    type filter hook forward priority -10
    meta l4proto tcp ct original proto-dst {port} drop
  }}
}}
"""


class ThisMachine(Place):
    """The machine of the tests, without a network namespace."""

    def command(self, argv: Sequence[str]) -> list[str]:
        return [*argv]

    @contextmanager
    def entered(self) -> Iterator[None]:
        yield


THIS_MACHINE = ThisMachine("tests", "", "")


def rows(browser: Browser) -> list[Json]:
    """The rows of the table of links."""
    table: list[Json] = browser.run(ROWS)
    return table


def row(browser: Browser, name: str, **wanted: str) -> Json:
    """Wait for a row of a topic with the ``wanted`` cells. Raises AssertionError after 90 s."""
    seen: list[Json] = []

    def fits() -> bool:
        seen[:] = [topic_row for topic_row in rows(browser) if topic_row["Name"] == name]
        return any(wanted.items() <= topic_row.items() for topic_row in seen)

    try:
        wait_until(f"the row of {name} has {wanted}", fits, 90)
    except AssertionError as error:
        raise AssertionError(f"{error}; the rows are {seen}") from None
    return next(topic_row for topic_row in seen if wanted.items() <= topic_row.items())


def line(browser: Browser, source: str, target: str) -> Json:
    """A line of the graph between two boxes: the colour and the label."""
    edge: Json | None = browser.run(LINE, source, target)
    assert edge, f"no line from {source} to {target}"
    return {**edge, "colour": edge["colour"].replace(" ", "")}


def box_colour(browser: Browser, name: str) -> str:
    """The colour of a box of the graph; empty if there is none."""
    return str(browser.run(BOX, name)).replace(" ", "")


def node_rows(browser: Browser, name: str) -> list[list[str]]:
    """The rows of a node: state, name, where, address, ports, MB/s, and the problem."""
    table: list[list[str]] = browser.run(NODES)
    return [cells for cells in table if cells[1] == name]


def trouble(browser: Browser) -> str:
    """The text of all findings on the page."""
    return str(browser.run(TROUBLE))


def title(browser: Browser) -> str:
    """The title of the page."""
    return str(browser.run(TITLE))


def colour(browser: Browser, name: str) -> str:
    """The computed colour of a class of the style sheet, such as ``ok`` or ``broken``."""
    script = """
    const span = document.createElement("span");
    span.className = arguments[0];
    document.body.append(span);
    const found = getComputedStyle(span).color;
    span.remove();
    return found;
    """
    return str(browser.run(script, name)).replace(" ", "")


def port_of(lab: Lab, name: str) -> int:
    """The port at which outside reaches a node inside."""
    port = urlsplit(lab.node_uri(name) or "").port
    assert port
    return port


@contextmanager
def cut(lab: Lab, port: int) -> Iterator[None]:
    """Have the host drop all packets of a published port, in both directions."""
    enter = ("ip", "netns", "exec", lab.place("host").namespace)
    run_command(*enter, "nft", "-f", "-", text=CUT.format(port=port))
    try:
        yield
    finally:
        run_command(*enter, "nft", "delete", "table", "ip", "cut")


@contextmanager
def serving(browser: Browser, place: Place, log: Path, port: int, *words: str) -> Iterator[Process]:
    """Run a module that serves a page at a port of the browser's machine, and open the page.

    ``words``: the name of the module, and the arguments after the port.
    """
    paths = os.pathsep.join(path for path in sys.path if path)
    environment = clean_environment(PYTHONPATH=paths, PYTHONUNBUFFERED="1")
    command = [sys.executable, "-m", words[0], str(port), *words[1:]]
    server = Process(words[0], place, command, environment, log)
    try:
        server.wait_for("^serving", timeout=60)
        browser.open(f"http://127.0.0.1:{port}/")
        yield server
        # Leave the page before the server ends: a lost connection is an error in the console.
        browser.open("about:blank")
    finally:
        server.kill()


@contextmanager
def made_up(
    browser: Browser, folder: Path, nodes: int, module: str = "many", place: Place = THIS_MACHINE
) -> Iterator[Process]:
    """Show a page with made-up nodes in the browser, and yield the server of the page."""
    words = f"tests.browser.{module}", str(nodes)
    with serving(browser, place, folder / "made-up.log", MANY_PORT, *words) as server:
        yield server


def play(lab: Lab) -> dict[str, Any]:
    """Start nodes of a usual robot on all machines. Return ``port``: the port of the planner."""
    start = lab.node
    start("roscpp", "c1", "pub", name="recognizer", topic="/objects", rate=10)
    start("roscpp", "c1", "sub", name="viewer", topic="/camera/image")
    start("roscpp", "c2", "pub", name="planner", topic="/plan", rate=5, size=2000)
    start("roscpp", "out", "pub", name="camera", topic="/camera/image", rate=20, size=30000)
    start("roscpp", "out", "sub", name="arm", topic="/plan")
    start("roscpp", "out", "sub", name="logger", topic="/objects")
    for name in ("recognizer", "viewer", "planner", "camera", "arm", "logger"):
        lab.wait_registered(name)
    return {"port": port_of(lab, "planner")}
