"""The real proxy as a separate process: `python -m rosproxy run`."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from asyncio.subprocess import DEVNULL, PIPE, STDOUT, Process
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from time import monotonic

START_SECONDS = 60.0
"""Time limit of a start. Long, so that a slow machine does not fail."""
STOP_SECONDS = 10.0
"""Time from SIGTERM to SIGKILL."""


class DemoError(Exception):
    """The demonstration cannot go on; the text is for the user."""


def clean_environment(**more: str) -> dict[str, str]:
    """The environment without the variables of ROS, of a proxy and of the terminal."""
    foreign = ("ROS_", "ROSPROXY_", "COLUMNS", "LINES")
    kept = {k: v for k, v in os.environ.items() if not k.startswith(foreign)}
    return kept | more


class ProxyProcess:
    """A proxy with the given `options`.

    `state` is "not started", "starting", "ready", "killed" or "ended". `log` has the last log
    lines.
    """

    def __init__(self) -> None:
        self.options: Sequence[str] = ()
        self.state = "not started"
        self.log: deque[str] = deque(maxlen=40)
        self._process: Process | None = None
        self._reader: asyncio.Task[None] | None = None

    async def start(self) -> float:
        """Start the proxy and wait until ready. Return the seconds. Raises DemoError."""
        began = monotonic()
        self.state = "starting"
        # In a separate session, so that Ctrl-C ends the demonstration and not the proxy.
        self._process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "rosproxy", "run", *self.options),
            stdin=DEVNULL,
            stdout=PIPE,
            stderr=STDOUT,
            start_new_session=True,
            env=clean_environment(PYTHONPATH=str(Path(__file__).parents[2])),
        )
        ready = asyncio.Event()
        self._reader = asyncio.create_task(self._read(self._process, ready))
        with suppress(TimeoutError):
            await asyncio.wait_for(ready.wait(), START_SECONDS)
        if self.state != "ready":
            raise DemoError(f"the proxy isn't ready, but {self.state}")
        return monotonic() - began

    async def kill(self) -> None:
        """Kill the proxy with SIGKILL."""
        await self._end(signal.SIGKILL)
        self.state = "killed"

    async def stop(self) -> None:
        """Stop the proxy with SIGTERM, and kill a proxy that does not end."""
        await self._end(signal.SIGTERM)

    async def _end(self, number: signal.Signals) -> None:
        if self._process and self._reader:
            with suppress(ProcessLookupError):
                self._process.send_signal(number)
                with suppress(TimeoutError):
                    await asyncio.wait_for(self._process.wait(), STOP_SECONDS)
                self._process.kill()
            await self._reader

    async def _read(self, process: Process, ready: asyncio.Event) -> None:
        """Keep the log until the process has ended."""
        if process.stdout is not None:
            async for line in process.stdout:
                self.log.append(line.decode("utf-8", "replace").rstrip())
                if " listening: " in self.log[-1]:
                    self.state = "ready"
                    ready.set()
        await process.wait()
        self.state = "ended"
        ready.set()
