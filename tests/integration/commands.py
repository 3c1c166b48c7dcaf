"""Run ``rosproxy`` commands as separate processes."""

import asyncio
import sys
from dataclasses import dataclass

from examples.demo.proxy_process import clean_environment
from tests.integration.proxy import Proxy


@dataclass(frozen=True)
class Result:
    """The exit code and the output of a command."""

    code: int
    out: str
    err: str


async def run(*words: str, within: float = 60.0, **environment: str) -> Result:
    """Run ``rosproxy`` with these words until the process ends."""
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
    """The URL of a proxy's admin endpoint."""
    return f"http://{proxy.settings.admin}"
