"""The summary of the real-ROS layer: cases by file, and the times that were measured."""

from __future__ import annotations

import json
from collections import defaultdict
from pathlib import Path

import pytest


class Report:
    """Counts cases and keeps measured times, in seconds."""

    def __init__(self, flat: bool) -> None:
        self.flat = flat
        self.outcomes: dict[str, bool] = {}
        self.times: dict[str, list[float]] = defaultdict(list)

    @property
    def run(self) -> int:
        return len(self.outcomes)

    def add(self, result: pytest.TestReport) -> None:
        """Counts a phase of a case. A case passes if all phases pass."""
        if not result.skipped:
            self.outcomes[result.nodeid] = self.outcomes.get(result.nodeid, True) and result.passed
        if result.when == "call":
            for name, seconds in result.user_properties:
                self.times[name].append(float(str(seconds)))

    def by_file(self) -> dict[str, tuple[int, int]]:
        """For each test file: (passed, run)."""
        counts: dict[str, list[bool]] = defaultdict(list)
        for nodeid, passed in self.outcomes.items():
            counts[Path(nodeid.partition("::")[0]).stem].append(passed)
        return {name: (sum(results), len(results)) for name, results in sorted(counts.items())}

    def lines(self) -> list[str]:
        passed = sum(self.outcomes.values())
        route = "no boundary, no proxy" if self.flat else "through the proxy"
        lines = [f"real ROS nodes, {route}: {passed} of {self.run} cases passed"]
        lines += [f"  {name}: {good} of {run}" for name, (good, run) in self.by_file().items()]
        for name, times in sorted(self.times.items()):
            lines.append(f"  {name}: {', '.join(f'{seconds:.2f}' for seconds in times)} s")
        return lines

    def write(self, path: Path) -> None:
        """Writes the same as JSON."""
        path.parent.mkdir(parents=True, exist_ok=True)
        content = {
            "through_proxy": not self.flat,
            "passed": sum(self.outcomes.values()),
            "run": self.run,
            "files": {k: {"passed": p, "run": r} for k, (p, r) in self.by_file().items()},
            "seconds": self.times,
            "failed": [name for name, passed in self.outcomes.items() if not passed],
        }
        path.write_text(json.dumps(content, indent=2) + "\n")


def measure(item: pytest.Item, name: str, seconds: float) -> None:
    """Notes a measured time with a case."""
    print(f"measured {name}: {seconds:.2f} s")
    item.user_properties.append((name, round(seconds, 3)))


KEY = pytest.StashKey[Report]()
