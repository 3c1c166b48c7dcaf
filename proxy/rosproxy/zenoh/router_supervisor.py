"""Supervises the router process: starts the process, reads reports, restarts the process.

Nodes of rmw_zenoh dial a router again 1, 3, 7 and 11 seconds after the connection has ended. So if
the routers are back within a second, the first of these tries succeeds. The proxy kills a process
without reports, which counts as hung. The proxy also kills a process that does not confirm changed
configurations by a report, so that no router keeps former rules.
"""

import asyncio
import contextlib
import json
import logging
import signal
import sys
from asyncio.subprocess import PIPE, Process
from collections.abc import Awaitable, Callable, Iterable, Sequence
from typing import TypeVar

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.output.text import brief
from rosproxy.shared.tasks import Tasks
from rosproxy.zenoh.protocol.library_log import (
    certificate_refusal,
    is_about_dialing,
    is_about_links,
    note_dialing,
)
from rosproxy.zenoh.protocol.report import LONGEST_REPORT, Report, read_report
from rosproxy.zenoh.router_configs import RouterConfig

log = logging.getLogger(__name__)

REPORT_TIMEOUT_S = 10.0
"""Seconds without a report after which the process counts as hung."""
START_TIMEOUT_S = 30.0
"""Seconds without a first report after which a new process counts as hung."""
CHANGE_TIMEOUT_S = 5.0
"""Seconds in which a process has to open routers with other configurations."""
LEAST_START_INTERVAL_S = 1.0
"""Seconds between two starts of the process. A process that has run longer starts again at once,
after LEAST_PAUSE_S."""
LEAST_PAUSE_S = 0.3
"""Seconds between the end of a process and the next start. Other routers recompute their routes
0.1 s after the end. If the next process connects before, they never send it their subscriptions
(`rosproxy.zenoh.router_process.REOPEN_PAUSE_S`)."""
MOST_LOG_LINES = 20
"""Lines of the library's own log that the proxy logs, for each process."""
LONGEST_LOG_LINE = 300
"""Characters of such a line that the proxy logs."""
LAST_LINES_TIMEOUT_S = 0.2
"""Seconds to read such lines after the end of the process."""
_Stream = TypeVar("_Stream")
PROGRAM = (sys.executable, "-m", "rosproxy.zenoh.router_process")


class RoutersFailed(Exception):
    """The routers do not run; the text says why."""


class RouterSupervisor:
    """Runs the router process of a proxy.

    ``take_report`` gets each report. ``refuse`` gets the reason for each certificate of another
    site that the routers refuse. ``failure``: why no routers run; empty while the routers run.
    ``restarts``: the number of processes that have ended.
    ``connected``: the endpoints to which the routers have connected, and that they have not dialed
    again, with the time of the event loop in seconds.
    """

    def __init__(
        self,
        tasks: Tasks,
        take_report: Callable[[Report], Awaitable[None]],
        refuse: Callable[[str], None] = log.warning,
    ) -> None:
        self._refuse = refuse
        self._tasks = tasks
        self._revision = 1
        self._line = b""
        self._confirmed = 0
        self._process: Process | None = None
        self._take_report = take_report
        self._first_outcome = asyncio.Event()
        self._reported = asyncio.Event()
        self.program: Sequence[str] = PROGRAM
        self.failure = "the routers have not started yet"
        self.restarts = 0
        self.connected = dict[str, float]()

    async def start(self, configs: Sequence[RouterConfig]) -> None:
        """Start the process, and wait until the routers run.

        Raises RoutersFailed if the first process fails. Later processes start nevertheless.
        """
        self._line = _line(self._revision, configs)
        self._tasks.spawn(self._keep_running(), "running the zenoh routers")
        await self._first_outcome.wait()
        if self.failure:
            raise RoutersFailed(self.failure)

    async def use(self, configs: Sequence[RouterConfig]) -> None:
        """Put other configurations in force: the process restarts the routers with changes.

        Returns when no router runs with a former configuration. If the process does not confirm the
        change, this method kills the process, and the next process uses the new configurations.
        """
        self._revision += 1
        revision = self._revision
        self._line = _line(revision, configs)
        process = self._process
        if process is None:  # the next process gets the line
            return
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            _piped(process.stdin).write(self._line)
        try:
            async with asyncio.timeout(CHANGE_TIMEOUT_S):
                while self._confirmed < revision and process is self._process:
                    self._reported.clear()
                    await self._reported.wait()
        except TimeoutError:
            log.error("zenoh routers do not confirm a change within %g s", CHANGE_TIMEOUT_S)
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()

    def end_connections(self, remotes: Iterable[HostPort]) -> None:
        """Let the process end the connections to these addresses. The hub then dials again."""
        line = json.dumps({"end": [[end.host, end.port] for end in remotes]}).encode() + b"\n"
        if self._process is not None:
            with contextlib.suppress(BrokenPipeError, ConnectionResetError):
                _piped(self._process.stdin).write(line)

    async def _keep_running(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            began = loop.time()
            self.failure = await self._run_once()
            self._first_outcome.set()
            self.restarts += 1
            log.error("zenoh routers ended: %s; starting the routers again", self.failure)
            await asyncio.sleep(max(began + LEAST_START_INTERVAL_S - loop.time(), LEAST_PAUSE_S))

    async def _run_once(self) -> str:
        """Run a process, and return why the process has ended."""
        try:
            process = await asyncio.create_subprocess_exec(
                *self.program, stdin=PIPE, stdout=PIPE, stderr=PIPE, limit=LONGEST_REPORT
            )
        except OSError as error:  # no memory, or too many processes
            return f"the process can't be started: {error.strerror}"
        self.connected = dict[str, float]()
        logging_task = self._tasks.spawn(
            _log_lines(_piped(process.stderr), self._refuse, self.connected),
            "reading the log of routers",
        )
        self._process = process
        try:
            _piped(process.stdin).write(self._line)
            return await self._read_reports(process)
        finally:
            # zenoh may hang while it ends sessions, so kill it. Nodes see the end in both cases.
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()
            self._process = None
            self._reported.set()
            # The last lines may name the cause of the end.
            await asyncio.wait({logging_task}, timeout=LAST_LINES_TIMEOUT_S)
            logging_task.cancel()

    async def _read_reports(self, process: Process) -> str:
        """Take reports until the process ends, fails or hangs. Return the reason."""
        reports = _piped(process.stdout)
        timeout = START_TIMEOUT_S
        while True:
            try:
                async with asyncio.timeout(timeout):
                    line = await reports.readline()
                if not line:
                    return _exit_reason(await process.wait())
                report = read_report(line)
            except TimeoutError:
                return f"no report for {timeout:g} s"
            except ValueError as error:  # not valid, or longer than the limit
                return brief(error, LONGEST_LOG_LINE)
            if report.error:
                return brief(report.error, LONGEST_LOG_LINE)
            timeout = REPORT_TIMEOUT_S
            await self._take_report(report)
            self.failure = ""
            self._confirmed = max(self._confirmed, report.revision)
            self._first_outcome.set()
            self._reported.set()


def _line(revision: int, configs: Sequence[RouterConfig]) -> bytes:
    """The line of standard input for the router process."""
    return json.dumps({"revision": revision, "routers": configs}).encode() + b"\n"


def _piped(stream: _Stream | None) -> _Stream:
    """A stream of a process that was started with pipes."""
    if stream is None:
        raise ValueError("the process has no such pipe")
    return stream


def _exit_reason(status: int) -> str:
    if status >= 0:
        return f"the process ended with status {status}"
    return f"the process was ended by {signal.Signals(-status).name}"


async def _log_lines(
    stream: asyncio.StreamReader, refuse: Callable[[str], None], connected: dict[str, float]
) -> None:
    """Log what the library prints, up to a bound, and read the rest. See `note_dialing`."""
    count = 0
    while line := await _read_line(stream):
        text = line.decode(errors="replace").strip()
        if is_about_links(text):
            if reason := certificate_refusal(text):
                refuse(reason)
            continue
        if is_about_dialing(text):
            note_dialing(text, connected, asyncio.get_running_loop().time())
            continue
        count += 1
        if count <= MOST_LOG_LINES:
            log.warning("zenoh: %s", brief(text, LONGEST_LOG_LINE))


async def _read_line(stream: asyncio.StreamReader) -> bytes:
    """The next line, or a part of a line that is too long; empty at the end."""
    try:
        return await stream.readline()
    except ValueError:  # asyncio has dropped the line (streams.py, StreamReader.readline)
        return b"(a line that is too long)"
