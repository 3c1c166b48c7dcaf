"""The arithmetic of the benchmark, and the content of its pages."""

import os
from pathlib import Path

import pytest

from rosproxy_operator.docker.controller import LOOK_MESSAGE
from tests.bench import docker, report
from tests.bench.book import DIRECT, Book, in_turn, loss, percentile, ratio, smallest_share
from tests.bench.streams import Spent, per_second
from tests.bench.world import processors


def filled() -> Book:
    """A book with two rounds of a row at two sizes, and a single round of another row."""
    book = Book({"machine": "2 cores"})
    book.begin("streams")
    for direct, ours in ((100.0, 50.0), (400.0, 300.0)):
        for size in (1, 10):
            book.add("rate, MB/s", DIRECT, direct, size)
            book.add("rate, MB/s", "rosproxy", ours, size)
    book.add("6 MB: loss, %", "rosproxy", 0)
    book.note("nginx is not installed and was not compared")
    return book


def test_ratio_is_the_median_of_the_rounds_own_ratios() -> None:
    """In the second round the machine was half as fast, for both."""
    assert ratio([50, 20, 60], [100, 50, 100]) == 0.5
    assert ratio([10.0], [40.0]) == 0.25


def test_ratio_of_rounds_that_do_not_pair_is_that_of_the_medians() -> None:
    assert ratio([30.0], [50.0, 60.0, 70.0]) == 0.5


@pytest.mark.parametrize("base", [[], [0.0], [1.0, 0.0]])
def test_no_ratio_to_nothing(base: list[float]) -> None:
    assert ratio([1.0] * len(base), base) is None


@pytest.mark.parametrize(("percent", "value"), [(50, 50), (99, 99), (100, 100), (1, 1), (0.5, 1)])
def test_percentile_is_a_value_that_was_measured(percent: float, value: float) -> None:
    assert percentile([float(number) for number in range(100, 0, -1)], percent) == value


def test_percentile_of_a_single_value() -> None:
    assert percentile([7.0], 99) == 7


def test_smallest_share() -> None:
    assert smallest_share([2, 4, 6]) == 0.5
    assert smallest_share([3, 3]) == 1
    assert smallest_share([0, 6]) == 0
    assert smallest_share([0, 0]) == 0


def test_loss() -> None:
    assert loss(200, 150) == 0.25
    assert loss(200, 200) == 0
    assert loss(0, 0) == 0
    assert loss(10, 11) == 0, "a message of before is no gain"


def test_cpu_is_by_the_time_between_two_readings() -> None:
    """However late the second reading comes."""
    before = Spent(10.0, 3.0, 7.0)
    after = Spent(12.0, 4.0, 10.0)
    assert per_second(before, after) == (0.5, 1.5)


def test_outside_and_inside_share_no_processor_but_a_single_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for cpus, parts in (({3}, ("3", "3")), ({0, 1}, ("0", "1")), ({0, 2, 5}, ("0", "2,5"))):
        monkeypatch.setattr(os, "sched_getaffinity", lambda _, cpus=cpus: cpus)
        assert (processors()["inside"], processors()["outside"]) == parts


def test_lines_have_spread_and_ratio() -> None:
    ours = next(line for line in filled().lines() if line.path == "rosproxy")
    spread = {"median": 175, "lowest": 50, "highest": 300, "to_direct": (0.5 + 0.75) / 2}
    assert ours.as_json().items() >= spread.items()


def test_direct_has_no_ratio_and_a_row_without_direct_neither() -> None:
    lines = {(line.row, line.path): line.to_direct for line in filled().lines()}
    assert lines["rate, MB/s", DIRECT] is None
    assert lines["6 MB: loss, %", "rosproxy"] is None


def test_a_saved_book_is_the_same_book(tmp_path: Path) -> None:
    book = filled()
    book.save(tmp_path / "results.json")
    again = Book.load(tmp_path / "results.json")
    assert again.lines() == book.lines()
    assert (again.machine, again.axes, again.notes) == (book.machine, book.axes, book.notes)


def test_a_note_is_kept_once() -> None:
    book = filled()
    book.note("nginx is not installed and was not compared")
    assert len(book.notes) == 1


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0, "0"),
        (-2.0, "-2"),
        (0.0312, "0.0312"),
        (0.00001, "< 0.001"),
        (12.345, "12.3"),
        (999.4, "999"),
        (999.6, "1,000"),
        (1234567, "1,234,567"),
    ],
)
def test_numbers(value: float, text: str) -> None:
    assert report.number(value) == text


def test_markdown_has_a_column_for_each_size() -> None:
    text = report.markdown(filled(), ["streams"])
    assert "| rate, MB/s; connections: | 1 | 10 |" in text
    assert "| rosproxy | 175 **x 0.62** (50 .. 300) | 175 **x 0.62** (50 .. 300) |" in text
    assert "| loss, % | rosproxy |" in text
    assert "| 6 MB | 0 |" in text
    assert "measure: median and spread against connections](streams.svg)" in text
    assert "\nnginx is not installed and was not compared.\n" in text


def test_results_are_pasted_between_the_marks_alone(tmp_path: Path) -> None:
    page = tmp_path / "performance.md"
    folder = tmp_path / "results"
    folder.mkdir()
    page.write_text(f"before\n{report.BEGIN}\nold\n{report.END}\nafter\n")
    (folder / "performance.md").write_text("![Plots](streams.svg)\n")
    (folder / "streams.svg").write_text("<svg/>")
    for _ in range(2):
        report.paste(page, folder)
    linked = "![Plots](performance/streams.svg)"
    assert page.read_text() == f"before\n{report.BEGIN}\n\n{linked}\n\n{report.END}\nafter\n"
    assert (tmp_path / "performance/streams.svg").read_text() == "<svg/>"


def test_a_page_without_marks_is_left_alone(tmp_path: Path) -> None:
    page = tmp_path / "performance.md"
    page.write_text("text")
    with pytest.raises(SystemExit, match="results"):
        report.paste(page, tmp_path)
    assert page.read_text() == "text"


def test_each_way_begins_a_round_once() -> None:
    orders = [in_turn("abc", number) for number in range(4)]
    assert orders == [["a", "b", "c"], ["b", "c", "a"], ["c", "a", "b"], ["a", "b", "c"]]


def test_the_section_docker_finds_the_looks_in_the_operators_log() -> None:
    line = docker.LOOK_LINE.search(LOOK_MESSAGE % (0.25, 3, None))
    assert line is not None
    assert line.groups() == ("0.250", "3")
