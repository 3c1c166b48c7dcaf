"""The demo's processes, seen from their parent: started, asked, killed, and always cleaned up."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import os
import signal
import sys
import time
from asyncio.subprocess import DEVNULL, PIPE, STDOUT, Process
from collections import deque
from collections.abc import AsyncIterator, Callable, Sequence
from pathlib import Path
from typing import Any

STOP_SECONDS = 3.0
"""How long a process may take to end when asked to, before it is killed."""
KEPT_LINES = 40
LINE_LIMIT = 1 << 20


class DemoError(Exception):
    """Something that keeps the demo from going on; the text is for the user."""


async def until(ready: Callable[[], object], seconds: float, what: str) -> None:
    """Wait until `ready()` is true; raises DemoError naming `what` after `seconds`."""
    deadline = time.monotonic() + seconds
    while not ready():
        if time.monotonic() > deadline:
            raise DemoError(f"{what}: not within {seconds:g} s")
        await asyncio.sleep(0.01)


def _environment() -> dict[str, str]:
    """The environment of the demo's processes: ours, without anything that sets up ROS."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("ROS_", "ROSPROXY_"))}
    source_root = str(Path(__file__).parents[2])
    paths = [source_root, *filter(None, [kept.get("PYTHONPATH")])]
    # The inside names resolve nowhere; a resolver that is slow to say so must not slow us down.
    return kept | {"PYTHONPATH": os.pathsep.join(paths), "RES_OPTIONS": "timeout:1 attempts:1"}


async def _start(arguments: Sequence[str], **pipes: Any) -> Process:
    """Start `python ARGUMENTS` in a session of its own: Ctrl-C is for the demo to handle."""
    command = (sys.executable, *arguments)
    return await asyncio.create_subprocess_exec(
        *command, env=_environment(), start_new_session=True, limit=LINE_LIMIT, **pipes
    )


class Supervised:
    """A process whose last words, read from `log`, are kept."""

    def __init__(self, name: str, process: Process, log: asyncio.StreamReader | None) -> None:
        self.name = name
        self.process = process
        self.last_words: deque[str] = deque(maxlen=KEPT_LINES)
        self._readers = [asyncio.create_task(self._read_log(log))]

    async def _read_log(self, log: asyncio.StreamReader | None) -> None:
        async for line in _lines(log):
            self.last_words.append(line.decode("utf-8", "replace").rstrip())

    @property
    def running(self) -> bool:
        """Whether the process hasn't ended yet."""
        return self.process.returncode is None

    async def kill(self) -> None:
        """End it with SIGKILL."""
        with contextlib.suppress(ProcessLookupError):
            self.process.kill()
        await self._reap()

    async def stop(self) -> None:
        """Ask it to end, wait, and kill it if it doesn't."""
        self._ask_to_end()
        try:
            await asyncio.wait_for(self.process.wait(), STOP_SECONDS)
        except TimeoutError:
            with contextlib.suppress(ProcessLookupError):
                self.process.kill()
        await self._reap()

    def _ask_to_end(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            self.process.send_signal(signal.SIGTERM)

    async def _reap(self) -> None:
        await self.process.wait()
        await asyncio.gather(*self._readers)


async def _lines(stream: asyncio.StreamReader | None) -> AsyncIterator[bytes]:
    if stream is not None:
        async for line in stream:
            yield line


class Worker(Supervised):
    """A node or the master (see :mod:`.worker`); `state` is what it reported last."""

    def __init__(self, name: str, process: Process) -> None:
        super().__init__(name, process, process.stderr)
        self.state: dict[str, Any] = {}
        self._numbers = itertools.count(1)
        self._waiting: dict[int, asyncio.Future[dict[str, Any]]] = {}
        self._readers.append(asyncio.create_task(self._read_stdout()))

    async def _read_stdout(self) -> None:
        async for line in _lines(self.process.stdout):
            message = json.loads(line)
            self.state = message.get("state", self.state)
            waiting = self._waiting.pop(message.get("id", 0), None)
            if waiting is not None and not waiting.done():
                waiting.set_result(message)

    async def request(self, do: str, **arguments: Any) -> dict[str, Any]:
        """Have a command carried out; raises DemoError if there is no answer."""
        number = next(self._numbers)
        answer = self._waiting[number] = asyncio.get_running_loop().create_future()
        self._send(json.dumps({"id": number, "do": do, **arguments}).encode() + b"\n")
        try:
            return await asyncio.wait_for(answer, 10.0)
        except TimeoutError:
            raise DemoError(f"{self.name} doesn't answer") from None

    def _send(self, line: bytes) -> None:
        if self.process.stdin is None or not self.running:
            raise DemoError(f"{self.name} ended unexpectedly")
        self.process.stdin.write(line)

    def _ask_to_end(self) -> None:
        if self.process.stdin is not None:
            self.process.stdin.close()


class Processes:
    """Everything that the demo has started; leaving the context ends all of it."""

    def __init__(self) -> None:
        self._started: list[Supervised] = []

    async def __aenter__(self) -> Processes:
        return self

    async def __aexit__(self, *_: object) -> None:
        await asyncio.gather(*(one.stop() for one in self._started))

    async def worker(self, name: str, config: dict[str, Any]) -> Worker:
        """Start a node or the master."""
        arguments = ["-m", "rosproxy.demo.worker", json.dumps(config)]
        process = await _start(arguments, stdin=PIPE, stdout=PIPE, stderr=PIPE)
        worker = Worker(name, process)
        self._started.append(worker)
        return worker

    async def proxy(self, options: Sequence[str]) -> Supervised:
        """Start the real proxy."""
        arguments = ["-m", "rosproxy", "run", *options]
        process = await _start(arguments, stdin=DEVNULL, stdout=PIPE, stderr=STDOUT)
        proxy = Supervised("rosproxy", process, process.stdout)
        self._started.append(proxy)
        return proxy

    def last_words(self) -> list[str]:
        """Return what the processes last logged, each line with the process's name."""
        return [f"{one.name}: {line}" for one in self._started for line in one.last_words]
