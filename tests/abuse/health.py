"""Asks /healthz over and over, in a separate process, which the tests cannot hold up.

    python -m tests.abuse.health HOST PORT PID

At the end of standard input, the process prints the time of the longest answer in seconds of a
reference processor (`UNITS_PER_SECOND`). Time in which the proxy's event loop (process PID) or the
asker waits for a processor does not count, because other programs of this machine cause these
waits. All other time counts, also system calls that block the event loop.

A virtual machine's processors may be half as fast as a second before. So the asker does a constant
piece of work over and over while it waits, and divides the time of the answer by the mean time of
this work.
"""

import http.client
import select
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from statistics import mean
from types import TracebackType

INTERVAL = 0.05
PATIENCE = 30.0
PAUSE = 0.01
"""Seconds between two pieces of work."""
UNITS = 20_000
"""Units of work of a piece."""
UNITS_PER_SECOND = 12_000_000
"""What the reference processor does: a processor of 2.5 GHz with Python 3.11, undisturbed."""


def waited(thread: int) -> float:
    """Seconds that a thread, by its id, was ready to run, and had no processor so far."""
    _, nanoseconds, _ = Path(f"/proc/{thread}/schedstat").read_text().split()
    return int(nanoseconds) / 1e9


def slowness() -> float:
    """How long a processor of this machine takes now, if the reference processor takes 1."""
    began = time.thread_time()
    total = 0
    for number in range(UNITS):
        total += number * number % 7
    return (time.thread_time() - began) * UNITS_PER_SECOND / UNITS


def ask(host: str, port: int, pid: int) -> float:
    """The seconds of an answer on a new connection."""
    own = threading.get_native_id()
    began = time.monotonic() - waited(pid) - waited(own)
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
    return time.monotonic() - waited(pid) - waited(own) - began


def main() -> None:
    """Ask until standard input ends."""
    host = sys.argv[1]
    port = int(sys.argv[2])
    pid = int(sys.argv[3])
    longest = 0.0
    with ThreadPoolExecutor(max_workers=1) as asker:
        while not select.select([sys.stdin], [], [], INTERVAL)[0]:
            answer = asker.submit(ask, host, port, pid)
            times = [slowness()]
            while not answer.done():
                time.sleep(PAUSE)
                times.append(slowness())
            longest = max(longest, answer.result() / mean(times))
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
