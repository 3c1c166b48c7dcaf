"""Finds routers that the hub dials no more, although it has no session with them.

After the end of a session, zenoh dials the other router again. If the session ends within a few
milliseconds of its begin, zenoh never does (zenoh 1.7.2, orchestrator.rs: `closed_session` looks
for an endpoint that `peers_connector_retry` notes later). Only a new hub dials that router again.
"""

from collections.abc import Mapping

GRACE_S = 5.0
"""Seconds without a session, and since zenoh has connected. Reports of sessions are up to two
seconds old."""
INTERVAL_S = 60.0
"""Least seconds between two new hubs, because each interrupts all messages between containers and
outside. A router outside can end each session so early."""


class Redialing:
    """Decides when a new hub is needed. For each loss of a session, one new hub has to do."""

    def __init__(self) -> None:
        self._tried = set[str]()
        self._next = 0.0

    def due(
        self, down: Mapping[str, float], connected: Mapping[str, float], now: float
    ) -> list[str]:
        """The endpoints for which a new hub is needed now; empty if none is needed.

        ``down``: the endpoints without a session, and since when. ``connected``: the endpoints to
        which zenoh has connected, and when, if zenoh has not dialed them again. All times are in
        seconds.
        """
        self._tried &= down.keys()
        left = [
            endpoint
            for endpoint, since in down.items()
            if endpoint in connected.keys() - self._tried
            and now - max(since, connected[endpoint]) >= GRACE_S
        ]
        if not left or now < self._next:
            return []
        self._tried.update(left)
        self._next = now + INTERVAL_S
        return left
