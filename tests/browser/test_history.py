"""Tests the rates of the last minute on the live page, with made-up nodes."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.browser.page import CHOOSE, DETAILS, THIS_MACHINE, made_up, rows
from tests.browser.webdriver import Browser, Json
from tests.ros.processes import wait_until
from tests.ros.topology import Place

RECORD = """
return import("/history.js").then(({ curveOf, emptyHistory, lastMinute, minuteText, record }) => {
  const links = new Map();
  const rates = emptyHistory(0);
  let knownUntil = 0;
  arguments[0].forEach((seen, second) => {
    record(rates, links, 1000 * second, knownUntil);
    if (seen === "not connected") return;
    knownUntil = 1000 * second + 999;
    if (seen === "no link") links.clear();
    else links.set("link", seen === null ? {} : { rate: seen });
  });
  const link = links.get("link") || {};
  const values = lastMinute(rates, "link", link);
  return { kept: rates.rings.size, values, text: values.length ? minuteText(values, 0) : "",
    curve: curveOf(values, 590, 100), length: values.length };
});
"""
CURVE = """
const path = document.querySelector("#details figure path");
return path ? [path.getAttribute("d"), getComputedStyle(path).stroke] : ["", ""];
"""


@pytest.fixture
def machine() -> Place:
    """The machine of page and browser. No test here needs ROS."""
    return THIS_MACHINE


def recorded(browser: Browser, *seen: float | str | None) -> Json:
    """What the page keeps of a link after a minute: the rate of each second, or what happened."""
    answer: Json = browser.run(RECORD, [None] * (60 - len(seen)) + [*seen])
    return answer


@pytest.mark.parametrize(
    ("seen", "text", "curve"),
    [
        ([5e5] * 60, "0.5 MB/s in the last minute", "M0.0,0.0h0L10.0,0.0L20.0,0.0"),
        ([1e6] * 59 + [0.0], "0 to 1 MB/s in the last minute", "L580.0,0.0L590.0,100.0"),
        ([2e5, None, 1e5], "0.1 to 0.2 MB/s in the last minute, 58 s not known", "M590.0,50.0h0"),
        ([3e5, "not connected", 3e5], "0.3 MB/s in the last minute, 58 s not known", "M590"),
        (["no link", None], "", ""),
    ],
)
def test_seconds_without_a_rate_are_gaps(
    browser: Browser, tmp_path: Path, seen: list[float | str | None], text: str, curve: str
) -> None:
    with made_up(browser, tmp_path, 10):
        answer = recorded(browser, *seen)
    assert answer["text"] == text
    assert curve in answer["curve"]
    assert answer["length"] in (0, 60)


def test_nothing_is_kept_of_a_link_that_is_gone(browser: Browser, tmp_path: Path) -> None:
    with made_up(browser, tmp_path, 10):
        assert recorded(browser, 1e6, 1e6)["kept"] == 1
        gone = recorded(browser, 1e6, "no link", None)
    assert (gone["kept"], gone["text"]) == (0, "")


def test_the_details_of_a_link_show_the_last_minute(browser: Browser, tmp_path: Path) -> None:
    ends = "/group0/node0", "/outside0"
    with made_up(browser, tmp_path, 10):
        wait_until("the page shows rows", lambda: len(rows(browser)) == 10)
        wait_until(
            "the details have a curve",
            lambda: "in the last minute" in browser.run(CHOOSE, *ends),
        )
        wait_until("the curve has several seconds", lambda: browser.run(CURVE)[0].count("L") > 1)
        assert "s not known" in browser.run(DETAILS), "the page knows the time before it was opened"
        browser.prefer("light")
        light = browser.run(CURVE)[1]
        browser.prefer("dark")
        assert light != browser.run(CURVE)[1] != "none"
