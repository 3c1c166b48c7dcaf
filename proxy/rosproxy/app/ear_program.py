"""The ear as a program: started, and stopped by a signal."""

import asyncio
import logging

from rosproxy.app.signals import stop_event
from rosproxy.binding import setting_error_if_taken
from rosproxy.ros2.servers.multicast_ear import Ear, EarSettings

log = logging.getLogger(__name__)


def run_ear(settings: EarSettings) -> None:
    """Run it until a signal ends it. Raises SettingError if a port is taken."""
    asyncio.run(_run(settings))


async def _run(settings: EarSettings) -> None:
    ending = stop_event()
    ear = Ear(settings)
    try:
        with setting_error_if_taken("--bind", settings.bind):
            ear.start()
        log.info(
            "ready: carries announcements of domain %d between the LAN at %s and the proxy at %s",
            settings.domain,
            settings.lan,
            settings.proxy,
        )
        await ending.wait()
    finally:
        ear.close()
