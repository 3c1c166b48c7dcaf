"""Since when a problem on the live page is there, over several documents."""

from typing import Any

from rosproxy.page.problem_ages import ProblemAges

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
