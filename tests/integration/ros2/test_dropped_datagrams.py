"""Datagrams that the kernel drops are told: in the status, as a problem, and in the metrics."""

import socket
from collections.abc import AsyncIterator

import pytest
from prometheus_client import generate_latest

from examples.demo.fake_http import free_ports
from rosproxy.forwarding.buffer_sizes import UDP_RECEIVE_BUFFER_BYTES
from rosproxy.ros2.domain_problems import LEAST_OVERFLOWED
from rosproxy.ros2.stack import Ros2
from rosproxy.runtime import Runtime
from tests.integration.own_domain import own_domain
from tests.run_options import parse_settings

DOMAIN = own_domain()
PORTS = 16
DATAGRAM = bytes(60_000)
ENOUGH = 2 * UDP_RECEIVE_BUFFER_BYTES // len(DATAGRAM) + LEAST_OVERFLOWED
"""Datagrams that fill a receive buffer of the largest size, and of which enough are dropped."""


@pytest.fixture
async def ros2() -> AsyncIterator[Ros2]:
    first = free_ports(PORTS)
    told = {
        "ros": ("2",),
        "ros2_domain": (str(DOMAIN),),
        "advertise_host": "127.0.0.1",
        "port_range": f"{first}-{first + PORTS - 1}",
        "data_plane": "copy",
    }
    started = Ros2(Runtime(parse_settings(told)))
    await started.start()
    yield started
    await started.stop()


async def test_dropped_datagrams_are_told(ros2: Ros2) -> None:
    await ros2._look_at_domains()  # the number of dropped datagrams before
    (server,) = ros2.servers
    receiver = next(s for s in server.buffers.sockets if s.family is socket.AF_INET)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        # No await here, so the proxy reads nothing meanwhile.
        for _ in range(ENOUGH):
            sender.sendto(DATAGRAM, ("127.0.0.1", receiver.getsockname()[1]))

    await ros2._look_at_domains()
    await ros2._look_at_domains()  # a problem has to last for two looks

    (status,) = ros2.state.status()
    assert status.overflowed >= LEAST_OVERFLOWED
    assert status.overflowed_recently == status.overflowed
    texts = [problem.text for problem in ros2._runtime.problems.all()]
    assert any("the kernel drops some" in text for text in texts), texts
    name = f'rosproxy_ros2_overflowed_datagrams_total{{domain="{DOMAIN}"}}'
    assert (
        f"{name} {status.overflowed:.1f}"
        in generate_latest(ros2._runtime.metrics.registry).decode()
    )
