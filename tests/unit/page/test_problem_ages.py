"""Since when a problem on the live page is there, over several documents."""

from typing import Any

import pytest

from rosproxy.page.problem_ages import ProblemAges
from rosproxy.shared.documents.status_document import (
    EndpointStatus,
    MasterStatus,
    ProblemStatus,
    ProxyStatus,
    ZenohLinkStatus,
    ZenohStatus,
)
from rosproxy.shared.output.text import brief

EPOCH = 1000.0


def document(**states: str) -> dict[str, Any]:
    """A document with nodes in these states."""
    return {
        "nodes": {name: {"state": state} for name, state in states.items()},
        "links": {},
        "findings": [],
    }


def since(
    ages: ProblemAges, now: float, shown: dict[str, Any], *, is_complete: bool = True
) -> dict[str, Any]:
    """The times of the nodes with a problem in a document."""
    ages.add_to(shown, now, EPOCH, is_complete)
    return {
        name: node["wrong_since"] for name, node in shown["nodes"].items() if "wrong_since" in node
    }


def test_a_problem_keeps_its_time_until_it_is_gone() -> None:
    ages = ProblemAges()
    assert since(ages, 1.0, document(a="broken", b="ok")) == {"a": 1001}
    assert since(ages, 2.0, document(a="broken", b="warning")) == {"a": 1001, "b": 1002}
    assert since(ages, 3.0, document(a="ok", b="broken")) == {"b": 1003}
    assert since(ages, 4.0, document(a="broken", b="broken")) == {"a": 1004, "b": 1003}


def test_first_documents_of_an_opened_page_end_no_problem() -> None:
    ages = ProblemAges()
    since(ages, 1.0, document(a="broken", b="broken"))
    assert since(ages, 50.0, document(), is_complete=False) == {}
    assert since(ages, 51.0, document(c="broken"), is_complete=False) == {"c": 1051}
    assert since(ages, 52.0, document(a="broken", c="broken")) == {"a": 1001, "c": 1051}
    assert since(ages, 53.0, document(b="broken")) == {"b": 1053}


def test_a_problem_that_changes_before_all_is_known_keeps_its_own_time() -> None:
    ages = ProblemAges()
    since(ages, 1.0, document(a="broken"))
    assert since(ages, 50.0, document(a="warning"), is_complete=False) == {"a": 1050}
    assert since(ages, 51.0, document(a="warning")) == {"a": 1050}


def test_links_and_findings_have_times_also_if_a_count_in_the_text_grows() -> None:
    ages = ProblemAges()
    for now, count in ((1.0, 5), (2.0, 17)):
        shown = document()
        shown["links"]["x"] = {"state": "broken"}
        finding = {"severity": "error", "subject": "ports", "text": f"{count} are taken"}
        shown["findings"] = [finding | {"wrong_since": None}]
        ages.add_to(shown, now, EPOCH, is_complete=True)
        assert shown["links"]["x"]["wrong_since"] == 1001
        assert shown["findings"][0]["wrong_since"] == 1001


def test_a_time_that_a_proxy_has_set_stays() -> None:
    shown = document(a="broken")
    shown["nodes"]["a"]["wrong_since"] = 7
    assert since(ProblemAges(), 1.0, shown) == {"a": 7}


def test_a_time_of_a_proxy_in_the_future_is_replaced() -> None:
    """Otherwise the page of an operator shows an age of 0 s until the operator's clock is there."""
    ages = ProblemAges()
    shown = document(a="broken", b="broken")
    shown["nodes"]["a"]["wrong_since"] = EPOCH + 3600.0
    shown["nodes"]["b"]["wrong_since"] = EPOCH - 3600.0
    assert since(ages, 5.0, shown) == {"a": 1005, "b": EPOCH - 3600.0}


def first_row(
    ages: ProblemAges, now: float, status: ProxyStatus | None = None, **row: Any
) -> tuple[float, bool]:
    """The time of the problem of a node in the first document of an opened page."""
    key = row.pop("key", "a")
    node = {"state": "broken", **row}
    shown = document() | {"nodes": {key: node}}
    ages.add_to(shown, now, EPOCH, False, status)
    return node["wrong_since"], node.get("may_be_older", False)


def test_a_problem_of_the_first_documents_may_be_older_and_later_problems_may_not() -> None:
    ages = ProblemAges()
    assert first_row(ages, 1.0) == (1001, True)
    shown = document(a="broken", b="broken")
    assert since(ages, 40.0, shown) == {"a": 1001, "b": 1040}
    assert [shown["nodes"][name].get("may_be_older") for name in "ab"] == [True, None]


@pytest.mark.parametrize(
    ("key", "status"),
    [
        ("master", ProxyStatus(master=MasterStatus(error="refused", since=7200.0))),
        ("/talker", ProxyStatus(nodes=(EndpointStatus(nodes=("/talker",), unanswered=7200.0),))),
        (
            "router 10.0.0.2:7447",
            ProxyStatus(zenoh=ZenohStatus(links=(ZenohLinkStatus("10.0.0.2:7447", since=7200.0),))),
        ),
    ],
)
def test_the_proxy_knows_the_time_of_a_node_without_a_page(key: str, status: ProxyStatus) -> None:
    assert first_row(ProblemAges(), 9000.0, status, key=key) == (EPOCH + 1800, False)
    assert first_row(ProblemAges(), 9000.0, status, key="other") == (EPOCH + 9000, True)


@pytest.mark.parametrize("noted", ["deaf", "deaf. Fix: restart it", "deaf. restart it"])
def test_a_noted_problem_has_its_time_at_its_node_alone(noted: str) -> None:
    problem = ProblemStatus(age=5.0, subject="0102", text=noted, known_for=7200.0)
    status = ProxyStatus(problems=(problem,))
    row = {"text": "deaf", "fix": "restart it"}
    assert first_row(ProblemAges(), 9000.0, status, key="0 0102", **row) == (EPOCH + 1800, False)
    assert first_row(ProblemAges(), 9000.0, status, key="0 0103", **row)[1]
    assert first_row(ProblemAges(), 9000.0, status, key="0 0102", text="mute", fix="")[1]


def test_a_noted_text_is_bounded_and_still_found() -> None:
    row = {"text": "x" * 900, "fix": "restart it"}
    cut = brief(f"{row['text']}. Fix: {row['fix']}", 500)
    status = ProxyStatus(problems=(ProblemStatus(subject="a", text=cut, known_for=60.0),))
    assert first_row(ProblemAges(), 100.0, status, **row) == (EPOCH + 40, False)


def test_a_problem_that_the_page_saw_some_seconds_earlier_keeps_its_time() -> None:
    """An age in the status is rounded, and the proxy notes a problem after the page."""
    ages = ProblemAges()
    assert first_row(ages, 100.0, text="deaf") == (1100, True)
    for now in (110.0, 111.0, 112.0):
        noted = ProblemStatus(subject="a", text="deaf", known_for=round(now - 104.3) + 0.1)
        status = ProxyStatus(problems=(noted,))
        assert first_row(ages, now, status, text="deaf") == (1100, False)


def test_a_problem_that_came_back_without_a_page_has_its_new_time() -> None:
    ages = ProblemAges()
    old = ProxyStatus(master=MasterStatus(error="refused", since=50.0))
    new = ProxyStatus(master=MasterStatus(error="refused", since=20.0))
    assert first_row(ages, 100.0, old, key="master") == (1050, False)
    assert first_row(ages, 900.0, new, key="master") == (1880, False)
