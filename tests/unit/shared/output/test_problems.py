"""Problems: the newest stay, and texts are bounded."""

import time

from rosproxy.shared.output.problems import LONGEST_SUBJECT, LONGEST_TEXT, MOST_PROBLEMS, Problems


def test_only_the_newest_are_kept() -> None:
    problems = Problems()
    for number in range(MOST_PROBLEMS + 10):
        problems.add(f"/n{number}", "gone")
    assert [p.subject for p in problems.all()] == [f"/n{n}" for n in range(10, MOST_PROBLEMS + 10)]


def test_one_that_holds_stays_until_it_is_solved() -> None:
    problems = Problems()
    problems.add("published range", "dead", holds=True)
    for number in range(MOST_PROBLEMS + 10):
        problems.add(f"/n{number}", "gone")
    assert len(problems.all()) == MOST_PROBLEMS
    assert (problems.all()[0].subject, problems.all()[0].holds) == ("published range", True)
    problems.solved("published range")
    assert len(problems.all()) == MOST_PROBLEMS - 1


def test_the_same_again_replaces_the_older_one() -> None:
    problems = Problems()
    for text in ("gone", "deaf", "gone"):
        problems.add("/a", text)
    assert [p.text for p in problems.all()] == ["deaf", "gone"]


def test_the_same_again_keeps_the_time_when_it_was_first_noted() -> None:
    problems = Problems()
    problems.add("/a", "gone")
    (first,) = problems.all()
    while time.time() == first.when:
        time.sleep(0)
    problems.add("/a", "gone")
    (again,) = problems.all()
    assert again.since == first.since < again.when


def test_texts_of_any_size_are_short_and_harmless() -> None:
    problems = Problems()
    problems.add("/a\n" + "x" * 8_000_000, "y" * 8_000_000 + "\x1b[2J", port=5)
    (problem,) = problems.at(5)
    assert (len(problem.subject), len(problem.text)) == (LONGEST_SUBJECT, LONGEST_TEXT)
    assert problem.subject.startswith("/a\\nx")
    assert problem.text.endswith("y\\x1b[2J")


def test_what_was_noted_of_a_long_name_is_forgotten_when_it_is_solved() -> None:
    problems = Problems()
    name = "/" + "x" * 8000
    problems.add(name, "gone")
    problems.add("/b", "gone", port=7)
    problems.solved(name)
    problems.solved_at(7)
    assert problems.all() == []
