"""Where the kernel may forward topics to: the endpoints' state, seen from this machine."""

from collections.abc import Collection
from dataclasses import replace

from rosproxy.forwarding.kernel.policy import Pauses, World, destination
from rosproxy.forwarding.kernel.preflight import forwarding
from rosproxy.net.addresses import HostPort
from rosproxy.net.interfaces import address_towards
from rosproxy.ros1.context import Context
from rosproxy.ros1.registry.endpoint import Endpoint

OWN_TTL = 60.0
"""Seconds for which it is remembered which addresses are the proxy's own."""


class KernelTargets:
    """Where the kernel may forward each endpoint's topics to, or why it may not.

    ``why_not`` tells why it may forward nothing at all; None while it may.
    """

    def __init__(self, context: Context) -> None:
        self._context = context
        self._world, self._pauses = World(), Pauses()
        self._own: dict[str, bool] = {}
        self._own_until = 0.0
        self.why_not: str | None = "the proxy has not started yet"

    @property
    def usable(self) -> bool:
        """Whether the kernel may forward at all."""
        return self.why_not is None

    def refresh(self) -> None:
        """Take in what this network namespace forwards now, and at times its own addresses."""
        self._world = forwarding()
        if self._context.now() > self._own_until:
            self._own, self._own_until = {}, self._context.now() + OWN_TTL

    def of(self, endpoint: Endpoint) -> HostPort | str:
        """Where an endpoint's topics may be forwarded to, or why they may not."""
        if self.why_not is not None:
            return self.why_not
        address = endpoint.place.address
        own = {address} if self._is_own(address) else ()
        where = destination(endpoint, replace(self._world, own=own))
        if isinstance(where, str) or endpoint.fast_port is None:
            return where
        return self._pauses.why(endpoint.fast_port, where, self._context.now()) or where

    def allowed(self, endpoint: Endpoint) -> bool:
        """Whether an endpoint's topics could be forwarded if it had a fast port."""
        return isinstance(self.of(endpoint), HostPort)

    def pause(self, port: int, where: HostPort) -> None:
        """Note that nobody answers behind a forward; it is not made again for a while."""
        why = f"nothing came back from the node at {where} through the kernel"
        self._pauses.note(port, where, why, self._context.now())

    def keep(self, ports: Collection[int]) -> None:
        """Forget what was noted about all other ports."""
        self._pauses.keep(ports)

    def _is_own(self, address: str) -> bool:
        if address not in self._own:
            self._own[address] = address_towards(address) == address
        return self._own[address]
