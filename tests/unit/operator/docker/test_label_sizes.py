"""Labels of any length and number cost a container at most its own proxy."""

import pytest

from rosproxy_operator.common.problem import Problem
from rosproxy_operator.docker.planner.labels import members
from rosproxy_operator.docker.planner.labels.members import MOST_LABELS, MOST_UNKNOWN_LABELS
from rosproxy_operator.docker.planner.labels.readers import LABELS, MOST_VALUE_CHARACTERS
from tests.unit.operator.docker.builders import ENABLED, container, observed, read_members

LONGEST_PROBLEM = 1000
"""Characters, of which a list of all labels and some quoted values have the most."""


def told(**labels: str) -> list[Problem]:
    """The problems of a container with more labels, each of a bounded length."""
    _, problems = read_members(observed(container(labels={**ENABLED, **labels})))
    assert all(len(problem.message) < LONGEST_PROBLEM for problem in problems)
    return problems


def test_unknown_labels_are_told_up_to_a_number() -> None:
    problems = told(**{f"rosproxy.x{n:05}": "y" for n in range(10_000)})
    assert len(problems) == MOST_UNKNOWN_LABELS + 1
    assert problems[-1].message == (
        f"{10_000 - MOST_UNKNOWN_LABELS} more labels rosproxy.… are unknown and ignored. "
        "Remove these labels"
    )
    assert not any(problem.fatal for problem in problems)


def test_labels_without_the_one_that_counts_are_told_in_short() -> None:
    labels = {f"rosproxy.x{n:05}" + "y" * 1000: "" for n in range(100)}
    _, problems = read_members(observed(container(labels=labels)))
    assert problems[-1].message.endswith(
        "and 95 more ignored, since the label rosproxy.enable=true is missing. Add that label"
    )
    assert all(len(problem.message) < LONGEST_PROBLEM for problem in problems)


def test_the_name_of_a_label_may_be_long() -> None:
    (problem,) = told(**{"rosproxy." + "x" * 1_000_000: "y"})
    assert problem.message.startswith("label rosproxy.xxx")


def test_the_spelling_of_many_labels_is_not_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each check takes time, and each look reads all labels."""
    checked: set[str] = set()

    def nearest(name: str, *_: object) -> str:
        checked.add(name)
        return ""

    monkeypatch.setattr(members, "nearest", nearest)
    told(**{f"com.example.x{n:05}": "y" for n in range(10_000)})
    assert len(checked) <= MOST_LABELS + MOST_UNKNOWN_LABELS


@pytest.mark.parametrize("label", LABELS)
@pytest.mark.parametrize("ros", ["1", "2"])
def test_a_long_value_leaves_its_container_out(label: str, ros: str) -> None:
    labels = {**ENABLED, "rosproxy.ros": ros, label: "a," * MOST_VALUE_CHARACTERS}
    seen = observed(container("bad", labels), container("good"))
    served, problems = read_members(seen)
    assert [member.container.name for member in served] == ["good"]
    (problem,) = problems
    assert (problem.subject, problem.fatal) == ("container bad", True)
    assert f"label {label}" in problem.message
    assert len(problem.message) < LONGEST_PROBLEM


def test_a_host_name_is_not_longer_than_host_names_are() -> None:
    for length, served in ((253, 1), (254, 0)):
        uri = f"http://{'a' * length}:11311"
        labels = {"rosproxy.enable": "true"}
        found, problems = read_members(observed(container(labels=labels, env=uri)))
        assert len(found) == served
        assert len(problems) == 1 - served
