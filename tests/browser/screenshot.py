"""Make a picture of the live page with real nodes and a broken link: ``make screenshot``.

python -m tests.browser.screenshot FILE
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from tests.browser.page import URL, cut, play, row
from tests.browser.webdriver import Browser
from tests.ros.cpp import compiled_node
from tests.ros.forks import Forks
from tests.ros.lab import Lab
from tests.ros.topology import SHARED, Topology, remove_leftovers

WIDTH = 1200
HIGH = 760


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


def main() -> int:
    if len(sys.argv) != 2:
        print(__doc__, file=sys.stderr)
        return 2
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
    Path(sys.argv[1]).write_bytes(picture)
    return 0


if __name__ == "__main__":
    sys.exit(main())
