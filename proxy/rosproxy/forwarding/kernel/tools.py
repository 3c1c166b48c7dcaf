"""The two programs that change and read the kernel's tables: nft and conntrack.

In the image they are copies that carry the capability to do so as a file capability, for a user
who is not root.
"""

import asyncio
import os
import shutil
import subprocess
from pathlib import Path

IMAGE_FOLDER = Path("/usr/libexec/rosproxy")
"""Where the image has them; searched before the PATH."""
SYSTEM_FOLDERS = ("/usr/sbin", "/sbin")
"""Where they are outside of an unprivileged user's PATH."""
TIMEOUT = 5.0
"""Seconds that one of them may take."""
REMEDY = (
    "give the proxy's container the capability NET_ADMIN (cap_add: NET_ADMIN) and run it without "
    "no-new-privileges"
)
_PACKAGES = {"nft": "nftables", "conntrack": "conntrack"}


class ToolError(Exception):
    """One of the programs could not do what it was asked to; the text says why."""


class Tools:
    """nft and conntrack, wherever they are."""

    def __init__(self) -> None:
        self._running: set[asyncio.Future[str]] = set()

    async def settled(self) -> None:
        """Wait for runs whose tasks were cancelled: what they began they finish."""
        if self._running:
            await asyncio.wait(self._running)

    async def nft(self, *arguments: str, document: str = "") -> str:
        """Run nft, with a document on its standard input; what it prints. Raises ToolError."""
        return await self._run("nft", *arguments, document=document)

    async def list_flows(self, ipv6: bool, *options: str) -> str:
        """Return the tracked TCP connections that options select. Raises ToolError."""
        return await self._run("conntrack", "-L", *_selection(ipv6), *options)

    async def forget_flows(self, ipv6: bool, *options: str) -> None:
        """Delete the same. Raises ToolError."""
        try:
            await self._run("conntrack", "-D", *_selection(ipv6), *options)
        except ToolError as error:
            # conntrack fails if there was nothing to delete; kube-proxy looks for the same text
            # (pkg/proxy/conntrack, noConnectionToDelete).
            if "0 flow entries" not in str(error):
                raise

    async def _run(self, name: str, *arguments: str, document: str = "") -> str:
        loop = asyncio.get_running_loop()
        run = loop.run_in_executor(None, _run, [_find(name), *arguments], document)
        self._running.add(run)
        run.add_done_callback(self._ended)
        # Not `await run`, which would cancel it together with its task.
        await asyncio.wait({run})
        return run.result()

    def _ended(self, run: asyncio.Future[str]) -> None:
        """Forget a run, and take its failure for known: its task may have been cancelled."""
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
            timeout=TIMEOUT,
            check=False,
            env={"LC_ALL": "C"},  # messages are looked into here, in English
        )
    except subprocess.TimeoutExpired:
        raise ToolError(f"{command[0]} did not end in {TIMEOUT:g} s") from None
    except PermissionError as error:
        raise ToolError(f"{command[0]} may not run ({error.strerror}): {REMEDY}") from None
    except OSError as error:
        raise ToolError(f"{command[0]} can't run: {error.strerror}") from None
    if completed.returncode != 0:
        message = " ".join(completed.stderr.split())[:300]
        is_refused = "not permitted" in message or "you must be root" in message
        raise ToolError(f"{command[0]}: {message}" + (f": {REMEDY}" if is_refused else ""))
    return completed.stdout
