"""Asks /healthz over and over, in a separate process, which the tests cannot hold up.

    python -m tests.abuse.health HOST PORT PID

At the end of standard input, the process prints the time of the longest answer in seconds. Time in
which the proxy's event loop (process PID) or the asker waits for a processor does not count,
because other programs of this machine cause these waits. All other time counts, also system calls
that block the event loop.
"""

import http.client
import os
import select
import subprocess
import sys
import time
from pathlib import Path
from types import TracebackType

INTERVAL = 0.05
PATIENCE = 30.0


def waited(pid: str) -> float:
    """Seconds that the main thread of a process was ready to run, and had no processor so far."""
    _, nanoseconds, _ = Path(f"/proc/{pid}/task/{pid}/schedstat").read_text().split()
    return int(nanoseconds) / 1e9


def ask(host: str, port: int, pid: str) -> float:
    """The time of an answer on a new connection."""
    began = time.monotonic() - waited(pid) - waited(str(os.getpid()))
    connection = http.client.HTTPConnection(host, port, timeout=PATIENCE)
    try:
        connection.request("GET", "/healthz")
        status = connection.getresponse().status
    except OSError:
        return PATIENCE
    finally:
        connection.close()
    if status != 200:
        return PATIENCE
    return time.monotonic() - waited(pid) - waited(str(os.getpid())) - began


def main() -> None:
    """Ask until standard input ends."""
    longest = 0.0
    while not select.select([sys.stdin], [], [], INTERVAL)[0]:
        longest = max(longest, ask(sys.argv[1], int(sys.argv[2]), sys.argv[3]))
    print(longest)


class Health:
    """Runs this module as long as the context lasts. Then ``longest`` has the result."""

    longest = 0.0

    def __init__(self, host: str, port: int, pid: int) -> None:
        self._command = [sys.executable, "-m", "tests.abuse.health"]
        self._command += [host, str(port), str(pid)]

    def __enter__(self) -> "Health":
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        self._process = subprocess.Popen(self._command, text=True, **pipes)  # type: ignore[call-overload]
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        text, _ = self._process.communicate()
        self.longest = float(text)


if __name__ == "__main__":
    main()
