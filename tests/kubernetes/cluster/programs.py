"""Programs that outlive the command that started them."""

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.docker.engine import wait_until
from tests.kubernetes.cluster.layout import LOGS, STATE

_RUN = STATE / "run"
_ENVIRONMENT = {"GOGC": "400"}  # memory for time: fewer garbage collections


@dataclass(frozen=True)
class Program:
    """A program with a log and a pid file.

    ``namespace`` is the name of the program's network namespace below /run/netns.
    """

    name: str
    command: tuple[str | Path, ...]
    namespace: str = ""

    @property
    def log(self) -> Path:
        return LOGS / f"{self.name}.log"

    @property
    def _pid_file(self) -> Path:
        return _RUN / self.name

    @property
    def pid(self) -> int | None:
        """The process id, if the process still runs this program."""
        try:
            pid = int(self._pid_file.read_text())
        except (OSError, ValueError):
            return None
        own = b"\0".join(os.fsencode(str(argument)) for argument in self.command)
        return pid if own in command_line(pid) else None

    def start(self) -> None:
        """Start the program unless running."""
        if self.pid is not None:
            return
        for directory in (_RUN, LOGS):
            directory.mkdir(parents=True, exist_ok=True)
        # Not `ip netns exec`, which mounts a new /sys where a kubelet finds no cgroups.
        enter = ("nsenter", f"--net=/run/netns/{self.namespace}") if self.namespace else ()
        with self.log.open("ab") as output:
            process = subprocess.Popen(
                [*enter, *self.command],
                stdin=subprocess.DEVNULL, stdout=output, stderr=output,
                start_new_session=True, cwd="/", env={**os.environ, **_ENVIRONMENT},
            )  # fmt: skip
        self._pid_file.write_text(str(process.pid))
        # For a moment a process that has just become a program has no command line.
        wait_until(lambda: self.pid is not None or process.poll() is not None, 60, self.name)

    def kill(self) -> None:
        """Kill the program, like a loss of power."""
        if self.pid is not None:
            kill([self.pid])
        self._pid_file.unlink(missing_ok=True)

    def last_words(self) -> str:
        return "".join(self.log.read_text(errors="replace").splitlines(keepends=True)[-30:])


@contextmanager
def paused(program: Program) -> Iterator[None]:
    """Let a program do nothing meanwhile."""
    pid = program.pid
    assert pid is not None, f"{program.name} does not run"
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


def processes() -> list[int]:
    return [int(entry) for entry in os.listdir("/proc") if entry.isdigit()]


def command_line(pid: int) -> bytes:
    """The words of a process, each ended by a zero byte; empty if the process is gone or dead."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


def kill(pids: list[int], seconds: float = 20) -> None:
    """Kill processes and wait until all are gone."""
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    end = time.monotonic() + seconds
    while left := [pid for pid in pids if _alive(pid)]:
        if time.monotonic() > end:
            raise AssertionError(f"processes {left} can't be killed")
        time.sleep(0.02)


def _alive(pid: int) -> bool:
    """Whether a process still holds resources. A zombie with threads still holds its sockets."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text()
        threads = len(os.listdir(f"/proc/{pid}/task"))
    except OSError:
        return False
    return threads > 1 or text.rpartition(")")[2].split()[0] not in "ZX"
