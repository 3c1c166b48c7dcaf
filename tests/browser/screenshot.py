"""Make pictures of the live page: ``make screenshot``.

python -m tests.browser.screenshot FILE
python -m tests.browser.screenshot --containers FOLDER
python -m tests.browser.screenshot --made-up FOLDER

The first has six real nodes and a broken link. The second have forty real nodes in containers and
on machines (`tests.browser.containers`). The third have made-up robots (`tests.browser.robots`).
"""

from __future__ import annotations

import sys
import tempfile
from itertools import product
from pathlib import Path

from tests.browser.containers import firewall, fleet
from tests.browser.page import DETAILS, THIS_MACHINE, URL, cut, made_up, play, row, rows
from tests.browser.test_picture import geometry
from tests.browser.webdriver import Browser
from tests.docker.controller import ADMIN_BIND
from tests.ros.cpp import compiled_node
from tests.ros.forks import Forks
from tests.ros.lab import Lab
from tests.ros.processes import wait_until
from tests.ros.topology import SHARED, Topology, remove_leftovers

WIDTH = 1200
HIGH = 760
SIZES = (5, 30, 100, 1000)
DEVICES = {"desktop": (1440, 1000, 1), "phone": (390, 844, 2)}
"""Width and height in CSS pixels, and pixels of a CSS pixel."""
SCHEMES = ("light", "dark")
QUALITY = 70
CHOSEN = "/amr_01/camera/image_raw/compressed"
CHOSEN_SECONDS = 50
"""Seconds of the curve in the picture of a chosen link."""
CHOOSE = """
[...document.querySelectorAll("#boxes .line")].find((line) =>
  line.textContent.includes(arguments[0])).click();
"""
KNOWN = """
const text = document.querySelector("#details figcaption")?.textContent || "60 s not known";
return 60 - Number((text.match(/(\\d+) s not known/) || [0, 0])[1]);
"""


def paint(lab: Lab, folder: Path) -> bytes:
    """The picture of the page when the good links show messages and a link is broken."""
    port = play(lab)["port"]
    browser = Browser(lab.place("px"), folder)
    try:
        browser.resize(WIDTH, HIGH)
        browser.prefer("light")
        browser.open(URL)
        for topic in ("/objects", "/camera/image", "/plan"):
            row(browser, topic, State="ok", **{"Last message": "just now"})
        with cut(lab, port):
            row(browser, "/plan", State="BROKEN")
            row(browser, "/objects", State="ok", **{"Last message": "just now"})
            return browser.screenshot()
    finally:
        browser.close()


def paint_real(file: Path) -> None:
    """Write the picture with real nodes."""
    remove_leftovers()
    compiled_node()
    topology = Topology(SHARED)
    forks = Forks()
    with tempfile.TemporaryDirectory() as folder:
        topology.build()
        lab = Lab(topology, Path(folder), forks)
        try:
            lab.ensure_running()
            picture = paint(lab, Path(folder))
        finally:
            lab.stop()
            forks.stop()
            topology.remove()
    file.write_bytes(picture)


def paint_made_up(target: Path) -> None:
    """Write the pictures with made-up robots, and a picture with a chosen link."""
    target.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        browser = Browser(THIS_MACHINE, Path(folder))
        try:
            for nodes in SIZES:
                with made_up(browser, Path(folder), nodes, "robots"):
                    paint_all(browser, target, str(nodes))
            with made_up(browser, Path(folder), 30, "robots"):
                (target / "chosen.webp").write_bytes(paint_chosen(browser))
        finally:
            browser.close()


def paint_containers(target: Path) -> None:
    """Write the pictures of an operator's page with forty real nodes and a broken link."""
    target.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, fleet(Path(folder)):
        browser = Browser(THIS_MACHINE, Path(folder))
        try:
            browser.open(f"http://{ADMIN_BIND[1]}/")
            with firewall():
                paint_all(browser, target, "containers")
        finally:
            browser.close()


def paint_all(browser: Browser, target: Path, name: str) -> None:
    """Write the pictures with a name, for each device and scheme.

    Raises AssertionError if the graph has a fault, such as labels that overlap.
    """
    wait_until("the page shows rows", lambda: bool(rows(browser)))
    for (device, size), scheme in product(DEVICES.items(), SCHEMES):
        browser.resize(*size)
        browser.prefer(scheme)
        wait_until("the picture has this width", lambda: not geometry(browser))
        picture = browser.small_screenshot(QUALITY)
        (target / f"{name}-{device}-{scheme}.webp").write_bytes(picture)


def paint_chosen(browser: Browser) -> bytes:
    """The picture of a chosen link with the rate of the last minute."""
    browser.resize(*DEVICES["desktop"])
    browser.prefer("light")
    wait_until("the page shows rows", lambda: bool(rows(browser)))
    browser.run(CHOOSE, CHOSEN)
    assert CHOSEN in browser.run(DETAILS)
    wait_until("the curve is long", lambda: browser.run(KNOWN) >= CHOSEN_SECONDS, 90)
    return browser.small_screenshot(QUALITY)


def main() -> int:
    match sys.argv[1:]:
        case ["--containers", folder]:
            paint_containers(Path(folder))
        case ["--made-up", folder]:
            paint_made_up(Path(folder))
        case [file]:
            paint_real(Path(file))
        case _:
            print(__doc__, file=sys.stderr)
            return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
