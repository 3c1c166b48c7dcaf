"""The proxy of a test, in the test's own event loop."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

from examples.demo.fake_http import Address, free_ports, host_and_port
from examples.demo.fake_node import FakeNode
from rosproxy.app.process import App
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.stack import Ros1
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortRange
from rosproxy.shared.settings import Settings
from tests.integration.net import HOST, PATIENCE, PROXY, refuses, until
from tests.run_options import parse_settings

BY_THE_WALL = {"probe_timeout": 20.0}
"""Of proxies that go by the wall's clock: no node of theirs hangs because the machine is busy."""
PORTS = 8
"""The default number of a test proxy's ports for nodes."""


def options_for(**options: Any) -> dict[str, Any]:
    """Command-line options for a test: free ports, and patience measured in tenths of seconds.

    The kernel's tables of this machine are left alone, even if root runs the tests.
    ``publish_master`` may be True: on a free port.
    """
    count = options.pop("ports", PORTS)
    own = PortRange(*map(int, str(options.get("port_range", "0-0")).split("-")))
    first = free_ports(count + 3)
    while first <= own.last and own.first < first + count + 3:  # a former proxy's, free by now
        first = free_ports(count + 3)
    if options.get("publish_master") is True:
        options["publish_master"] = first + count + 2
    return {
        "advertise_host": HOST,
        "master_port": first + count,
        "admin_bind": f"127.0.0.1:{first + count + 1}",
        "port_range": f"{first}-{first + count - 1}",
        "inside_network": ("127.0.2.0/24",),
        "probe_interval": 0.3,
        "probe_timeout": 1.0,
        "cleanup_after": 1.0,
        "linger": 0.5,
        "master_interval": 0.2,
        "data_plane": "splice",
        **options,
    }


def settings_for(**options: Any) -> Settings:
    """The same as settings."""
    return parse_settings({"bind": "0.0.0.0", "slave_control": "any", **options_for(**options)})


class Proxy:
    """A running proxy and its addresses."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.app = App(settings)
        self.master: Address = (PROXY, settings.master_port)
        self._stopped = False

    @property
    def ros1(self) -> Ros1:
        """The stack for ROS 1."""
        return next(stack for stack in self.app.stacks if isinstance(stack, Ros1))

    async def start(self) -> None:
        """Begin."""
        await self.app.start()

    async def restart(self, while_down: Callable[[], Awaitable[None]] | None = None) -> None:
        """Lose all memory: end, and begin anew with the same settings."""
        await self.app.stop()
        if while_down:
            await while_down()
        self.app = App(self.settings)
        await self.start()

    async def stop(self) -> None:
        """End; the second time nothing."""
        if not self._stopped:
            self._stopped = True
            async with asyncio.timeout(PATIENCE):
                await self.app.stop()

    def metric(self, name: str, /, **labels: str) -> float:
        """The value of a metric; 0 before the first value with these labels."""
        registry = self.ros1.context.metrics.registry
        return registry.get_sample_value(f"rosproxy_{name}", labels) or 0

    async def serves(self, node: FakeNode) -> bool:
        """Whether a node's port is open."""
        return not await refuses(self.lease(node))

    async def quiet(self) -> None:
        """Wait until no connection is relayed any more."""
        await until(lambda: not self.metric("open_connections"), "all relays end")

    def endpoint(self, node: FakeNode) -> Endpoint:
        """The endpoint of a node."""
        slave = HostPort(node.address, node.slave.address[1])
        return next(e for e in self.ros1.context.registry if e.slave == slave)

    def lease(self, node: FakeNode) -> Address:
        """The address at which outside reaches a node."""
        endpoint = self.endpoint(node)
        return host_and_port(self.ros1.context.addressing.advertised_uri(endpoint))

    def uri(self, node: FakeNode) -> str:
        """A node's advertised slave URI."""
        return self.ros1.context.addressing.advertised_uri(self.endpoint(node))
