"""Why the kernel does not forward a port, as the status tells."""

from dataclasses import dataclass
from typing import cast

import pytest

from rosproxy.forwarding.kernel.plane import KernelPlane
from rosproxy.ros2.domain_plane import DomainPlane
from rosproxy.ros2.ports.kernel_ports import KernelPorts
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortPool
from tests.unit.ros2.discovery.domains import (
    INSIDE,
    NOW,
    ROBOT,
    A,
    B,
    make_domain,
    of_vendor,
    spdp,
)


class KernelForwards:
    """The part of a plane for ports that the kernel forwards."""

    user_plane = "copy"

    def status_of(self, _: object) -> dict[str, object]:
        return {
            "plane": "kernel",
            "reason": "",
            "received": 900,
            "received_packets": 9,
            "received_rate": 90.0,
            "packet_rate": 3.0,
        }


def test_user_data_is_what_the_proxy_and_the_kernel_have_passed_on() -> None:
    domain = make_domain()
    domain.heard_inside(spdp(A, INSIDE), INSIDE, NOW)
    mappings = KernelPorts(PortPool(domain.settings.ports.listen))
    mappings.domains.append(domain.mappings)
    participant = domain.inside.by_prefix[A]
    mapping = participant.mappings[HostPort(INSIDE, 7411)]
    mapping.update_rates(NOW)
    mapping.note_passed(100, has_samples=True)
    mapping.update_rates(NOW + 1)
    plane = cast(KernelPlane, KernelForwards())
    status = DomainPlane(plane, mappings).locator(participant, mapping)
    assert status.user_datagrams == 10
    assert (status.user_rate, status.user_datagram_rate) == (190.0, 4.0)


@dataclass
class Plane:
    """The part of a plane for a port that the kernel may not forward."""

    user_plane: str = "copy"


@pytest.mark.parametrize(
    ("prefix", "address", "port", "reason"),
    [
        (A, INSIDE, 7410, "the proxy reads and rewrites discovery"),
        (A, INSIDE, 7411, "Cyclone DDS may read discovery at this port"),
        (B, INSIDE, 7411, "another participant at the address may read discovery at this port"),
        (B, ROBOT, 7411, "the kernel forwards only to participants inside"),
    ],
)
def test_why_the_kernel_does_not_forward_a_port(
    prefix: bytes, address: str, port: int, reason: str
) -> None:
    domain = make_domain(both_ways=True)
    domain.heard_inside(of_vendor(spdp(A, INSIDE)), INSIDE, NOW)
    if address == ROBOT:
        domain.heard_outside(spdp(B, ROBOT), ROBOT, NOW)
    elif prefix == B:
        domain.heard_inside(spdp(B, INSIDE), INSIDE, NOW)
    mappings = KernelPorts(PortPool(domain.settings.ports.listen))
    mappings.domains.append(domain.mappings)
    table = domain.inside if address == INSIDE else domain.outside
    participant = table.by_prefix[prefix]
    mapping = participant.mappings[HostPort(address, port)]
    status = DomainPlane(cast(KernelPlane, Plane()), mappings).locator(participant, mapping)
    assert (status.plane, status.reason) == ("copy", reason)
