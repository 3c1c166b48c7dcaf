"""The two programs that change and read the kernel's tables: nft and conntrack.

The image has copies of both with a file capability, so that a user other than root may use both.
"""

import asyncio
import contextlib
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import cast

from rosproxy.shared.fixes import how_to

IMAGE_FOLDER = Path("/usr/libexec/rosproxy")
"""The folder of the programs in the image; searched before the PATH."""
SYSTEM_FOLDERS = ("/usr/sbin", "/sbin")
"""Folders to search after the PATH, which lacks these folders for an unprivileged user."""
RUN_TIMEOUT_S = 5.0
"""Seconds that a run of a program may take."""
LONGEST_LIST_BYTES = 16 * 1024 * 1024
"""Most bytes of a list of connections that the proxy reads: some 95,000 lines."""
PIECE_BYTES = 16 * 1024
"""Bytes of a list that the proxy reads at once: some hundred lines."""
ENVIRONMENT = {"LC_ALL": "C"}
"""English messages of the programs: the proxy looks for words in these messages."""
_PACKAGES = {"nft": "nftables", "conntrack": "conntrack"}


class ToolError(Exception):
    """A program has failed, or could not run; the text says why."""


class Tools:
    """Runs nft and conntrack."""

    def __init__(self) -> None:
        self._running: set[asyncio.Future[str]] = set()

    async def settled(self) -> None:
        """Wait for the end of all runs. A run continues after its task was cancelled."""
        if self._running:
            await asyncio.wait(self._running)

    async def nft(self, *arguments: str, document: str = "") -> str:
        """Run nft with a document on standard input; return the output. Raises ToolError."""
        return await self._run("nft", *arguments, document=document)

    async def list_flows(self, take: Callable[[str], None], ipv6: bool, *options: str) -> None:
        """Pass the tracked TCP connections that options select to ``take``. Raises ToolError.

        ``take`` gets whole lines in pieces of some PIECE_BYTES, so that other tasks run in between.
        After LONGEST_LIST_BYTES, the rest of the list is dropped without an error. If the calling
        task is cancelled, conntrack is killed.
        """
        command = [_find("conntrack"), "-L", *_selection(ipv6), *options]
        try:
            process = await asyncio.create_subprocess_exec(
                *command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=ENVIRONMENT
            )
        except OSError as error:
            raise _start_error(command[0], error) from None
        try:
            async with asyncio.timeout(RUN_TIMEOUT_S):
                if not await _pass_lines(cast(asyncio.StreamReader, process.stdout), take):
                    return
                _, complaint = await process.communicate()
        except TimeoutError:
            raise _timeout_error(command[0]) from None
        finally:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            # `wait` alone hangs while a pipe is full (asyncio.base_subprocess, _try_finish).
            await process.communicate()
        if process.returncode != 0:
            raise _failure(command[0], complaint.decode("utf-8", "replace"))

    async def forget_flows(self, ipv6: bool, *options: str) -> None:
        """Delete the tracked TCP connections that options select. Raises ToolError."""
        try:
            await self._run("conntrack", "-D", *_selection(ipv6), *options)
        except ToolError as error:
            # conntrack fails without a connection to delete; kube-proxy looks for the same text
            # (pkg/proxy/conntrack, noConnectionToDelete).
            if "0 flow entries" not in str(error):
                raise

    async def _run(self, name: str, *arguments: str, document: str = "") -> str:
        loop = asyncio.get_running_loop()
        run = loop.run_in_executor(None, _run, [_find(name), *arguments], document)
        self._running.add(run)
        run.add_done_callback(self._ended)
        # Not `await run`, which would cancel the run together with its task.
        await asyncio.wait({run})
        return run.result()

    def _ended(self, run: asyncio.Future[str]) -> None:
        """Remove a run, and read its exception: after a cancellation no task reads the exception.

        asyncio would log an exception that was never read.
        """
        self._running.discard(run)
        if not run.cancelled():
            run.exception()


def _selection(ipv6: bool) -> list[str]:
    return ["-f", "ipv6" if ipv6 else "ipv4", "-p", "tcp"]


def _find(name: str) -> str:
    folders = [str(IMAGE_FOLDER), os.environ.get("PATH", ""), *SYSTEM_FOLDERS]
    program = shutil.which(name, path=os.pathsep.join(folders))
    if program is None:
        package = _PACKAGES[name]
        raise ToolError(f"{name} is not installed where the proxy runs: install {package}")
    return program


def _run(command: list[str], document: str) -> str:
    try:
        completed = subprocess.run(  # noqa: S603 - a program found by its own name, no shell
            command,
            input=document,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=RUN_TIMEOUT_S,
            check=False,
            env=ENVIRONMENT,
        )
    except subprocess.TimeoutExpired:
        raise _timeout_error(command[0]) from None
    except OSError as error:
        raise _start_error(command[0], error) from None
    if completed.returncode != 0:
        raise _failure(command[0], completed.stderr)
    return completed.stdout


async def _pass_lines(stream: asyncio.StreamReader, take: Callable[[str], None]) -> bool:
    """Pass lines to ``take`` as they arrive; False beyond LONGEST_LIST_BYTES."""
    rest = b""
    count = 0
    while piece := await stream.read(PIECE_BYTES):
        count += len(piece)
        if count > LONGEST_LIST_BYTES:
            return False
        lines, newline, rest = (rest + piece).rpartition(b"\n")
        take((lines + newline).decode("utf-8", "replace"))
        # `read` returns at once while bytes are buffered.
        await asyncio.sleep(0)
    return True


def _timeout_error(program: str) -> ToolError:
    return ToolError(f"{program} did not end in {RUN_TIMEOUT_S:g} s")


def _start_error(program: str, error: OSError) -> ToolError:
    if isinstance(error, PermissionError):
        return ToolError(f"{program} may not run ({error.strerror}): {how_to('kernel rights')}")
    return ToolError(f"{program} can't run: {error.strerror}")


def _failure(program: str, complaint: str) -> ToolError:
    message = " ".join(complaint.split())[:300]
    is_refused = "not permitted" in message or "you must be root" in message
    fix = f": {how_to('kernel rights')}" if is_refused else ""
    return ToolError(f"{program}: {message}{fix}")
