"""ROS's Python programs as forks of a process on each machine that has imported rospy.

Importing rospy takes a third of a second of a processor, more than everything else in most tests,
and there are some hundred nodes and tools. The other end is nodes/forked.py.
"""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from tests.ros.cpp import NODES
from tests.ros.topology import Place

_POLL = 0.01


_TOOLS = ("rosnode", "rosparam", "rosservice", "rostopic")
PROGRAMS = {"node.py": str(NODES / "node.py"), **{name: f"/usr/bin/{name}" for name in _TOOLS}}
"""Programs that start as forks, by name."""


class Forks:
    """Starts Python programs on any machine."""

    def __init__(self) -> None:
        self._parents: dict[str, subprocess.Popen[str]] = {}

    def start(self, place: Place, argv: Sequence[str], env: Mapping[str, str], log: Path) -> Fork:
        """Starts a program of PROGRAMS with arguments."""
        ended = log.with_suffix(".ended")
        log.touch()
        parent = self._parents.get(place.namespace) or self._start_parent(place, env)
        assert parent.stdin is not None
        assert parent.stdout is not None
        request = {"argv": argv, "env": dict(env), "log": str(log), "ended": str(ended)}
        print(json.dumps(request), file=parent.stdin, flush=True)
        return Fork(int(parent.stdout.readline()), ended)

    def _start_parent(self, place: Place, env: Mapping[str, str]) -> subprocess.Popen[str]:
        parent = self._parents[place.namespace] = subprocess.Popen(
            place.command(["/usr/bin/python3", str(NODES / "forked.py")]),
            env=dict(env),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        return parent

    def stop(self) -> None:
        """Ends the processes that nodes are forks of, not the nodes."""
        for parent in self._parents.values():
            parent.kill()
            parent.communicate()


class Fork:
    """A program's process, with the interface of subprocess."""

    def __init__(self, pid: int, ended: Path) -> None:
        self.pid = pid
        self._ended = ended

    def poll(self) -> int | None:
        return int(self._ended.read_text()) if self._ended.exists() else None

    def wait(self, timeout: float = 60) -> int:
        """Raises subprocess.TimeoutExpired."""
        deadline = time.monotonic() + timeout
        while (code := self.poll()) is None:
            if time.monotonic() > deadline:
                raise subprocess.TimeoutExpired("a fork", timeout)
            time.sleep(_POLL)
        return code
