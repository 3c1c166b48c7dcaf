"""Asks /healthz over and over, in a process of its own, which the tests can't hold up.

    python -m tests.abuse.health HOST PORT

When its standard input ends, it prints how long the longest answer took, in seconds.
"""

import http.client
import select
import subprocess
import sys
import time
from types import TracebackType

INTERVAL = 0.05
PATIENCE = 30.0


def ask(host: str, port: int) -> float:
    """How long an answer takes, on a connection of its own."""
    began = time.monotonic()
    connection = http.client.HTTPConnection(host, port, timeout=PATIENCE)
    try:
        connection.request("GET", "/healthz")
        status = connection.getresponse().status
    except OSError:
        return PATIENCE
    finally:
        connection.close()
    return time.monotonic() - began if status == 200 else PATIENCE


def main() -> None:
    """Ask until standard input ends."""
    longest = 0.0
    while not select.select([sys.stdin], [], [], INTERVAL)[0]:
        longest = max(longest, ask(sys.argv[1], int(sys.argv[2])))
    print(longest)


class Health:
    """Runs this module as long as the context lasts; ``longest`` is what it then has found."""

    longest = 0.0

    def __init__(self, host: str, port: int) -> None:
        self._command = [sys.executable, "-m", "tests.abuse.health", host, str(port)]

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
