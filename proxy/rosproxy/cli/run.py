"""Running a proxy until a signal ends it."""

import asyncio
import contextlib
import signal
from collections.abc import Callable

from rosproxy.app import serve
from rosproxy.settings import Settings

new_event_loop: Callable[[], asyncio.AbstractEventLoop] = asyncio.new_event_loop
with contextlib.suppress(ImportError):
    from uvloop import new_event_loop


def run(settings: Settings) -> None:
    """Run a proxy. Raises SettingError if a port is taken."""
    with asyncio.Runner(loop_factory=new_event_loop) as runner:
        runner.run(_serve_until_signal(settings))


async def _serve_until_signal(settings: Settings) -> None:
    stopped = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stopped.set)
    await serve(settings, stopped)
