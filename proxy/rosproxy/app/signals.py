"""How a program is asked to end."""

import asyncio
import signal


def stop_event() -> asyncio.Event:
    """Set when a signal asks the process to end; needs a running event loop."""
    event = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, event.set)
    return event
