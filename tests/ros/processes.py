"""Programs on the machines of a topology: start, output, end."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from tests.ros.forks import Forks
from tests.ros.topology import Place

STOP_PATIENCE = 8.0
"""Seconds from SIGINT to SIGKILL."""
_POLL = 0.01


class Process:
    """A running program in a separate process group, with the output in a file."""

    def __init__(
        self, title: str, place: Place, argv: Sequence[str], env: Mapping[str, str], log: Path,
        forks: Forks | None = None,
    ) -> None:  # fmt: skip
        self.title = title
        self.log = log
        self.started = time.time()
        start = forks.start if forks else _execute
        self._popen = start(place, argv, env, log)

    @property
    def pid(self) -> int:
        return self._popen.pid

    @property
    def returncode(self) -> int | None:
        return self._popen.poll()

    def output(self, since: int = 0) -> str:
        """The output from character `since` on."""
        return self.log.read_text(errors="replace")[since:]

    def mark(self) -> int:
        """The present end of the output, as a `since` for later."""
        return len(self.output())

    def wait_for(self, pattern: str, timeout: float = 60.0, since: int = 0) -> re.Match[str]:
        """Waits until a line matches. Raises AssertionError with the output otherwise."""
        return self.wait_for_count(pattern, 1, timeout, since)[0]

    def wait_for_count(
        self, pattern: str, count: int, timeout: float = 60.0, since: int = 0
    ) -> list[re.Match[str]]:
        """Waits for `count` matches in the output. Returns all matches."""
        compiled = re.compile(pattern, re.MULTILINE)
        deadline = time.monotonic() + timeout
        while True:
            ended = self.returncode is not None
            matches = list(compiled.finditer(self.output(since)))
            if len(matches) >= count:
                return matches
            if ended or time.monotonic() > deadline:
                raise AssertionError(self._missed(pattern, count, len(matches), timeout))
            time.sleep(_POLL)

    def _missed(self, pattern: str, count: int, matched: int, timeout: float) -> str:
        state = f"within {timeout:g} s" if self.returncode is None else "before it ended"
        return (
            f"{self.title} printed {pattern!r} {matched} of {count} times {state}; "
            f"its output:\n{self.output()[-3000:]}"
        )

    def wait(self, timeout: float = 60.0) -> int:
        """Waits for the end. Returns the exit code."""
        try:
            return self._popen.wait(timeout)
        except subprocess.TimeoutExpired:
            text = f"{self.title} still runs after {timeout:g} s; its output:\n"
            raise AssertionError(text + self.output()[-3000:]) from None

    def send(self, number: signal.Signals) -> None:
        """Signals the whole process group, if the group still exists."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, number)

    def kill(self) -> None:
        """Kills the process and all descendants with SIGKILL, and reaps the process.

        roscore and roslaunch put every child into a separate process group.
        """
        for pid in (self.pid, *descendants(self.pid)):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.send(signal.SIGKILL)
        self._popen.wait()

    def stop(self, number: signal.Signals = signal.SIGINT) -> int:
        """Asks the process to end, kills the rest, and returns the exit code."""
        if self.returncode is None:
            self.send(signal.SIGCONT)
            self.send(number)
        return self.reap()

    def reap(self, patience: float = STOP_PATIENCE) -> int:
        """Waits for the end that was asked for, killing what takes too long to end."""
        deadline = time.monotonic() + patience
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._popen.wait(patience)
        while self._group_lives() and time.monotonic() < deadline:
            time.sleep(_POLL)
        self.kill()
        return self._popen.wait()

    def _group_lives(self) -> bool:
        """Whether the process, or a child in the group such as rosbag's recorder, still runs."""
        try:
            os.killpg(self.pid, 0)
        except ProcessLookupError:
            return False
        return True


def _execute(
    place: Place, argv: Sequence[str], env: Mapping[str, str], log: Path
) -> subprocess.Popen[bytes]:
    with log.open("wb") as output:
        return subprocess.Popen(
            place.command(argv),
            env=dict(env),
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )


def descendants(pid: int) -> list[int]:
    """All descendants of a process."""
    pids = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(OSError):
            for child in map(int, task.read_text().split()):
                pids += [child, *descendants(child)]
    return pids


def stop_all(processes: Sequence[Process], patience: float = STOP_PATIENCE) -> None:
    """Ends all processes at the same time."""
    running = [process for process in processes if process.returncode is None]
    for process in running:
        process.send(signal.SIGCONT)
        process.send(signal.SIGINT)
    for process in running:
        process.reap(patience)


def wait_until(condition: str, check: object, timeout: float = 60.0) -> None:
    """Polls the callable `check` until the result is true."""
    assert callable(check)
    deadline = time.monotonic() + timeout
    while not check():
        if time.monotonic() > deadline:
            raise AssertionError(f"not within {timeout:g} s: {condition}")
        time.sleep(0.05)
