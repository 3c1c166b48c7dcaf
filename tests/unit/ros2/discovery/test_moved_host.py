"""The advertised host has another address: outside meets the participants inside anew."""

from rosproxy.ros2.discovery.announcements.to_outside import REPEAT_INTERVAL_S
from rosproxy.ros2.discovery.rediscovery import SEPARATION_S
from rosproxy.ros2.protocol.rtps import source_prefix
from tests.unit.ros2.discovery.domains import (
    HOST,
    INSIDE,
    LAN_RELAY,
    NOW,
    RANGE,
    ROBOT,
    A,
    B,
    carried,
    make_domain,
    meet,
    reached_at,
    settle,
    spdp,
    to,
)

MOVED = "10.0.0.2"
MOVED_IPV6 = "fd77::2"


def test_outside_forgets_and_meets_participants_where_the_host_is_now() -> None:
    domain = make_domain()
    meet(domain)
    domain.heard_outside(carried(ROBOT, spdp(B, ROBOT)), LAN_RELAY.host, NOW)
    moved = domain.move_to((MOVED,), NOW)
    dispose_messages = [source_prefix(datagram) for datagram in to(moved, ROBOT)]
    assert dispose_messages == [domain.proxy_participants.discovery_participant.prefix, A]
    (again,) = to(settle(domain, NOW + SEPARATION_S), ROBOT)
    assert {locator.host for locator in reached_at(again)} == {MOVED}
    ports = {RANGE.advertised(port) for port in domain.inside.by_prefix[A].ports}
    assert {locator.port for locator in reached_at(again)} == ports
    later = NOW + SEPARATION_S + REPEAT_INTERVAL_S
    (repeated,) = to(domain.heard_inside(spdp(A, INSIDE), INSIDE, later), ROBOT)
    assert repeated == again


def test_the_discovery_participant_is_announced_where_the_host_is_now() -> None:
    domain = make_domain()
    domain.move_to((MOVED,), NOW)
    (announced,) = to(domain.proxy_participants.announced_outside(), ROBOT)
    assert {locator.host for locator in reached_at(announced)} == {MOVED}


def test_each_locator_keeps_its_family() -> None:
    domain = make_domain()
    domain.settings.hosts = (HOST, "fd77::1")
    meet(domain, address="fd30::11")
    domain.move_to((MOVED, MOVED_IPV6), NOW)
    (again,) = to(settle(domain, NOW + SEPARATION_S), ROBOT)
    assert {locator.host for locator in reached_at(again)} == {MOVED_IPV6}


def test_a_participant_without_a_port_keeps_no_other_from_moving() -> None:
    domain = make_domain()
    meet(domain)
    meet(domain, B, "172.30.0.7")
    domain.inside.by_prefix[A].announcement = b""
    domain.move_to((MOVED,), NOW)
    (again,) = to(settle(domain, NOW + SEPARATION_S), ROBOT)
    assert source_prefix(again) == B
