"""The program ``rosproxy lan-relay``, which runs a LAN relay until a signal."""

import asyncio
import logging

from rosproxy.app.signals import stop_event
from rosproxy.binding import setting_error_if_taken
from rosproxy.ros2.lan_relay.relay import LanRelay, LanRelaySettings

log = logging.getLogger(__name__)


def run_lan_relay(settings: LanRelaySettings) -> None:
    """Run a LAN relay until SIGINT or SIGTERM. Raises SettingError if the port is taken."""
    asyncio.run(_run(settings))


async def _run(settings: LanRelaySettings) -> None:
    ending = stop_event()
    lan_relay = LanRelay(settings)
    try:
        with setting_error_if_taken("--bind", settings.bind):
            lan_relay.start()
        log.info(
            "ready: carries announcements of domain %d between the LAN at %s and the proxy at %s",
            settings.domain,
            settings.lan,
            settings.proxy,
        )
        await ending.wait()
    finally:
        lan_relay.close()
