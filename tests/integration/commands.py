"""Running ``rosproxy`` commands as an operator does: each a process of its own."""

import asyncio
import sys
from dataclasses import dataclass

from examples.demo.proxy_process import clean_environment
from tests.integration.proxy import Proxy


@dataclass(frozen=True)
class Result:
    """How a command ended and what it printed."""

    code: int
    out: str
    err: str


async def run(*words: str, within: float = 60.0, **environment: str) -> Result:
    """Run ``rosproxy`` with these words to its end."""
    command = [sys.executable, "-m", "rosproxy", *words]
    process = await asyncio.create_subprocess_exec(
        *command,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
        env=clean_environment(**environment),
    )
    async with asyncio.timeout(within):
        out, err = await process.communicate()
    assert process.returncode is not None
    return Result(process.returncode, out.decode(), err.decode())


def admin_url(proxy: Proxy) -> str:
    """Where a proxy of a test has its admin endpoint."""
    return f"http://{proxy.settings.admin}"
