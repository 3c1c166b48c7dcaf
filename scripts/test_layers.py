"""Run layers of tests, and report results and durations.

    python -m scripts.test_layers --smoke          Run the tests of `make test`.
    python -m scripts.test_layers                  Run the tests of `make test-all`.
    python -m scripts.test_layers unit ros         Run these layers only.

The steps (`layers` declares the layers):

  1. Install packages, programs and images that the layers need, by scripts that do nothing if all
     is installed. Meanwhile run the unit tests, which load does not disturb.
  2. Run the integration tests alone, because these check tenths of seconds.
  3. Run the layers with real nodes, engines and browsers, two side by side. With three, the load
     was 30 to 55 on two processors, and tests took up to sixty times as long. The layers with a
     Docker engine take turns on one side: these share the engine, take longest, and mostly wait.
  4. Run alone: the abuse layer, which fails if an answer takes too long, and ROS 2 in a cluster. In
     the cluster two dozen participants rediscover each other after each replaced pod of a proxy.
     For this Fast DDS takes two whole processors for seconds, and minutes beside other layers.
  5. Run failed tests once more, alone (`second_look` has the reason). There is no second run if
     more than `MOST_FAILED` tests failed, and none in layers without a second look.

With --smoke, the unit and integration tests run as a whole. The other layers run only the tests
marked `smoke`, or do not run. So `make test-all` includes all of `make test`.

The output of each step goes to build/test-logs. The output of a layer is shown when the layer ends,
the output of a preparation only when the preparation fails. The summary names each layer that this
machine cannot run, with the reason. With CI=true in the environment such a layer is a failure, so a
pipeline never turns green by leaving a layer out. The end of the summary and
build/test-logs/flaky.txt list flaky tests. The run fails if more than `MOST_FLAKY` tests are flaky;
with STRICT=1, if any test is flaky.
"""

import argparse
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from xml.etree import ElementTree

from scripts import layers
from scripts.layers import COMMANDS, LAYERS, LOGS, MARKED, NONE, ROOT, Layer
from scripts.second_look import Case, Flake, flakes, flaky_failure, is_worth_second_run, read_cases

TESTS_FAILED = 1
"""Exit code of pytest if all tests ran and some failed, without an error of pytest."""


@dataclass(frozen=True)
class Outcome:
    """The result of a layer.

    ``accepted``: whether the run may pass with this result. ``text``: the counts and the duration,
    or the reason why the layer did not run. ``cases``: all tests of the layer, only if some failed.
    ``flaky``: tests that passed in the second run.
    """

    layer: Layer
    ran: bool
    accepted: bool
    text: str
    cases: Mapping[str, Case] = field(default_factory=dict)
    flaky: tuple[Flake, ...] = ()

    @property
    def result_word(self) -> str:
        """The word for the summary."""
        if not self.accepted:
            return "FAILED"
        return "flaky" if self.flaky else "ok" if self.ran else "--"


class Run:
    """A run of some layers."""

    def __init__(self, chosen: Iterable[Layer], smoke: bool) -> None:
        self.layers = list(chosen)
        self.smoke = smoke
        self._started = time.monotonic()
        self._failed: set[str] = set()
        self._printing = threading.Lock()

    def run_all(self) -> list[Outcome]:
        """Prepare the machine and run the layers. Return the outcomes in the order of `LAYERS`."""
        LOGS.mkdir(parents=True, exist_ok=True)
        with ThreadPoolExecutor() as pool:
            unit = pool.submit(self._run_layers, deque(layers.BESIDE_PREPARATION))
            self._prepare()
        outcomes = unit.result() + self._run_layers(deque(layers.ALONE_FIRST))
        rest = deque(layers.SIDE_BY_SIDE)
        with ThreadPoolExecutor() as pool:
            lanes = [
                pool.submit(self._run_layers, deque(layers.ON_THE_ENGINE), rest),
                pool.submit(self._run_layers, rest),
            ]
        outcomes += [outcome for lane in lanes for outcome in lane.result()]
        outcomes += self._run_layers(deque(layers.ALONE_LAST))
        if is_worth_second_run(case for outcome in outcomes for case in outcome.cases.values()):
            outcomes = [self._run_failed_again(outcome) for outcome in outcomes]
        return sorted(outcomes, key=lambda outcome: LAYERS.index(outcome.layer))

    def _prepare(self) -> None:
        able = [layer for layer in self.layers if layer.obstacle() is None]
        for step in dict.fromkeys(step for layer in able for step in self._steps(layer)):
            code, text = self._run(step, COMMANDS[step])
            if code:
                self._failed.add(step)
                self._say(f"{step} failed:\n{text}")

    def _steps(self, layer: Layer) -> tuple[str, ...]:
        return layer.smoke_setup if self.smoke else layer.setup

    def _run_layers(self, *queues: deque[Layer]) -> list[Outcome]:
        """Run layers from the queues until the queues are empty. Two threads may share a queue."""
        outcomes = []
        for left in queues:
            while left:
                try:
                    layer = left.popleft()
                except IndexError:  # another thread was faster
                    break
                if layer in self.layers:
                    outcomes.append(self._run_layer(layer))
        return outcomes

    def _run_layer(self, layer: Layer) -> Outcome:
        obstacle = layer.obstacle()
        if obstacle is not None:
            return Outcome(layer, False, os.environ.get("CI") != "true", f"did not run: {obstacle}")
        missing = [step for step in self._steps(layer) if step in self._failed]
        if missing:
            return Outcome(layer, False, False, f"did not run: {missing[0]} failed")
        began = time.monotonic()
        for again in (False, True):
            layer.report(again).unlink(missing_ok=True)
        shutil.rmtree(layer.cache, ignore_errors=True)
        code, text = self._run(f"tests/{layer.name}", layer.command(self.smoke))
        self._say(f"=== {layer.name} ===\n{text}")
        report = layer.report()
        numbers = count(report) if report.exists() else "no report"
        text = f"{numbers} in {time.monotonic() - began:.0f} s"
        cases = read_cases(report) if code == TESTS_FAILED else {}
        return Outcome(layer, True, code == 0, text, cases)

    def _run_failed_again(self, outcome: Outcome) -> Outcome:
        """Run the failed tests of a layer once more, if the layer has a second look."""
        layer = outcome.layer
        if not outcome.cases or not layer.second_look:
            return outcome
        code, text = self._run(f"tests/{layer.name} again", layer.command(self.smoke, again=True))
        self._say(f"=== {layer.name}: second run of failed tests ===\n{text}")
        if code != 0:
            return outcome
        flaky = flakes(outcome.cases, read_cases(layer.report(again=True)))
        return replace(outcome, accepted=bool(flaky), flaky=flaky)

    def _run(self, title: str, command: list[str]) -> tuple[int, str]:
        """Run a step. Return the exit code and the output."""
        log = LOGS / f"{title.replace('/', '-').replace(' ', '-')}.log"
        began = time.monotonic()
        self._say(f"{title} …")
        with log.open("wb") as output:
            code = subprocess.run(
                command, cwd=ROOT, check=False, stdout=output, stderr=subprocess.STDOUT
            ).returncode
        self._say(f"{title}: {'failed' if code else 'ok'} after {time.monotonic() - began:.0f} s")
        return code, log.read_text(errors="replace")

    def _say(self, text: str) -> None:
        with self._printing:
            print(f"[{time.monotonic() - self._started:4.0f} s] {text}", flush=True)

    def summary(self, outcomes: list[Outcome], flaky_reason: str | None) -> str:
        """Return the summary of all layers.

        ``flaky_reason``: why the run fails because of flaky tests, or None.
        """
        minutes, seconds = divmod(round(time.monotonic() - self._started), 60)
        lines = ["", f"Test layers, {minutes} min {seconds} s in all:"]
        for outcome in outcomes:
            only = " (smoke)" if self.smoke and outcome.layer.smoke == MARKED else ""
            lines.append(
                f"  {outcome.layer.name + only:<16} {outcome.result_word:<7} {outcome.text}"
            )
        if self.smoke:
            lines.append(
                "The whole of each layer, the chart and a Kubernetes cluster: make test-all"
            )
        flaky = [flake for outcome in outcomes for flake in outcome.flaky]
        if flaky:
            lines.append("A flaky test is a bug, of the product or of the test (CONTRIBUTING.md):")
        lines += [f"  FLAKY {flake}" for flake in flaky]
        return "\n".join([*lines, *([f"Failed: {flaky_reason}"] if flaky_reason else [])])


def note_flaky(outcomes: Iterable[Outcome]) -> int:
    """Write the flaky tests to build/test-logs/flaky.txt, one a line. Return their number."""
    flaky = [flake for outcome in outcomes for flake in outcome.flaky]
    (LOGS / "flaky.txt").write_text("".join(f"{flake}\n" for flake in flaky))
    return len(flaky)


def count(report: Path) -> str:
    """Return the counts of a JUnit report, in one line."""
    suites = list(ElementTree.parse(report).getroot().iter("testsuite"))

    def total(name: str) -> int:
        return sum(int(suite.get(name, 0)) for suite in suites)

    failed = total("failures") + total("errors")
    skipped = total("skipped")
    passed = total("tests") - failed - skipped
    parts = [f"{passed} passed", f"{failed} failed", f"{skipped} skipped"]
    return ", ".join(parts[: 1 if not failed + skipped else 3])


def main() -> int:
    names = [layer.name for layer in LAYERS]
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--smoke", action="store_true", help="run a small part of the layers with real programs"
    )
    parser.add_argument("layers", nargs="*", metavar="layer", help=", ".join(names))
    options = parser.parse_args()
    if unknown := set(options.layers) - set(names):
        parser.error(f"no such layer: {', '.join(sorted(unknown))}")
    # The tests start hundreds of programs. Without bytecode files each would compile the project
    # anew.
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    # A shell ignores SIGINT for background jobs, and programs under test inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    chosen = [layer for layer in LAYERS if not options.layers or layer.name in options.layers]
    if options.smoke:
        chosen = [layer for layer in chosen if layer.smoke != NONE]
    run = Run(chosen, options.smoke)
    outcomes = run.run_all()
    flaky_reason = flaky_failure(note_flaky(outcomes), os.environ.get("STRICT") == "1")
    print(run.summary(outcomes, flaky_reason))
    return 0 if flaky_reason is None and all(outcome.accepted for outcome in outcomes) else 1


if __name__ == "__main__":
    sys.exit(main())
