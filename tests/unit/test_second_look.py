"""Tests that fail at first and pass alone are flaky and bounded. Tests that fail twice fail the
run.
"""

import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
from scripts import layers
from scripts.layers import LAYERS, Layer
from scripts.second_look import (
    MOST_FAILED,
    MOST_FLAKY,
    Case,
    flakes,
    flaky_failure,
    is_worth_second_run,
    read_cases,
)

TESTS = """
from pathlib import Path
import pytest

@pytest.fixture
def ended_badly(tmp_path_factory):
    yield
    if not (mark := Path(__file__).with_name("cleaned-up")).exists():
        mark.touch()
        raise OSError

def test_good():
    pass

@pytest.mark.parametrize("word", ["a/b.c"])
def test_late(word):
    if not (mark := Path(__file__).with_name("tried")).exists():
        mark.touch()
        raise AssertionError

def test_cleaned_up_late(ended_badly):
    pass

def test_wrong():
    assert WRONG
"""


@pytest.fixture
def layer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Layer:
    monkeypatch.setattr(layers, "LOGS", tmp_path / "logs")
    monkeypatch.setenv("PYTEST_ADDOPTS", "")
    monkeypatch.delenv("PYTEST_XDIST_WORKER", raising=False)
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    return Layer("some", tests=(f"--rootdir={tmp_path}", str(tmp_path / "test_it.py")), workers=1)


@pytest.mark.parametrize("wrong", [True, False])
def test_what_failed_is_tried_again_and_nothing_else(
    layer: Layer, tmp_path: Path, wrong: bool
) -> None:
    (tmp_path / "test_it.py").write_text(TESTS.replace("WRONG", str(not wrong)))
    codes = [
        subprocess.run(
            layer.command(smoke=False, again=again), cwd=tmp_path, check=False, capture_output=True
        ).returncode
        for again in (False, True)
    ]
    assert codes == [1, int(wrong)]
    first = read_cases(layer.report())
    again = read_cases(layer.report(again=True))
    late = {"test_it.py::test_late[a/b.c]", "test_it.py::test_cleaned_up_late"}
    failed = late | ({"test_it.py::test_wrong"} if wrong else set())
    assert {case.name for case in first.values() if case.failed} == failed
    assert len(first) == 4
    assert set(again) == failed
    assert {flake.name for flake in flakes(first, again)} == (set() if wrong else late)


def case(name: str, *, passed: bool = False, failed: bool = False, seconds: float = 1) -> Case:
    return Case(name, seconds, passed, failed)


@pytest.mark.parametrize("again", [{}, {"a": case("a")}, {"a": case("a", failed=True)}])
def test_what_did_not_pass_again_is_not_flaky(again: dict[str, Case]) -> None:
    assert not flakes({"a": case("a", failed=True), "b": case("b", passed=True)}, again)


def test_a_flake_tells_both_durations() -> None:
    (flake,) = flakes(
        {"t": case("t", failed=True, seconds=31)}, {"t": case("t", passed=True, seconds=0.25)}
    )
    assert str(flake) == "t: failed after 31.0 s, passed alone after 0.2 s"


def test_so_many_flaky_tests_refuse_a_run() -> None:
    assert [
        bool(flaky_failure(count, strict=False)) for count in (0, MOST_FLAKY, MOST_FLAKY + 1)
    ] == [*(False, False, True)]
    assert [bool(flaky_failure(count, strict=True)) for count in (0, 1)] == [False, True]


def test_a_run_in_which_all_fails_ends_soon() -> None:
    few = [case(str(n), failed=True) for n in range(MOST_FAILED)]
    assert is_worth_second_run(
        [*few, *(replace(failure, failed=False, passed=True) for failure in few)]
    )
    assert not is_worth_second_run([*few, case("more", failed=True)])


def test_each_layer_runs_once_and_what_is_pure_has_no_second_look() -> None:
    phases = (
        *(layers.BESIDE_PREPARATION, layers.ALONE_FIRST, layers.ON_THE_ENGINE),
        *(layers.SIDE_BY_SIDE, layers.ALONE_LAST),
    )
    assert sorted(layer.name for phase in phases for layer in phase) == sorted(
        layer.name for layer in LAYERS
    )
    assert {layer.name for layer in LAYERS if not layer.second_look} == {"unit", "chart"}


def test_layers_on_the_one_docker_engine_take_turns() -> None:
    assert not [layer.name for layer in layers.SIDE_BY_SIDE if layers.ENGINE in layer.setup]


def test_the_gate_is_the_short_one() -> None:
    gate = (layers.ROOT / ".ci/run").read_text()
    assert [line for line in gate.splitlines() if line.startswith("make")] == [
        *("make check", "make test")
    ]
