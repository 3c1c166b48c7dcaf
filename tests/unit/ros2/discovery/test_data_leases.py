"""Which ports the kernel may forward: those of user data, and what it was told before the start."""

from rosproxy.forwarding.kernel.decisions import HostForwarding, destination
from rosproxy.leases.ports import PortPool
from rosproxy.net.addresses import HostPort, Route
from rosproxy.ros2.discovery.data_leases import DataLeases
from rosproxy.ros2.discovery.domain import Domain
from rosproxy.ros2.ports.former_ports import ANSWER_TIME
from rosproxy.ros2.ports.locator_ports import SETTLING
from rosproxy.ros2.registry.participants import LeaseKind
from tests.unit.ros2.discovery.domains import (
    INSIDE,
    OTHER,
    A,
    B,
    dispose_message,
    make_domain,
    meet,
    of_vendor,
    settle,
    spdp,
)

LOCATOR = HostPort(INSIDE, 7411)


def data_leases_of(domain: Domain) -> DataLeases:
    leases = DataLeases(PortPool(domain.settings.ports.listen))
    leases.domains.append(domain.inside)
    return leases


def led(leases: DataLeases) -> dict[int, HostPort]:
    return {lease.port: lease.target for lease in leases}


def test_only_user_data_is_forwarded() -> None:
    domain = make_domain()
    leases = data_leases_of(domain)
    assert led(leases) == {}
    meet(domain)
    ((port, target),) = led(leases).items()
    assert target == LOCATOR
    assert domain.inside.leases[port][1].kind is LeaseKind.DATA
    (lease,) = leases
    assert destination(lease, HostForwarding(), Route("172.30.0.2", 1500), False) == LOCATOR
    assert destination(lease, HostForwarding(), Route(INSIDE, 1500), False) != LOCATOR


def test_a_locator_that_turns_out_to_be_of_metatraffic_is_not_forwarded() -> None:
    domain = make_domain()
    leases = data_leases_of(domain)
    meet(domain)
    (lease,) = leases
    domain.heard_inside(spdp(A, INSIDE, LOCATOR.port), INSIDE, 100)
    assert lease.port not in led(leases)


def test_who_keeps_a_lease_is_the_same_and_who_comes_after_is_not() -> None:
    domain = make_domain()
    leases = data_leases_of(domain)
    meet(domain)
    (first,) = leases
    meet(domain, B, OTHER)
    assert [lease for lease in leases if lease is first]
    domain.heard_inside(dispose_message(A), INSIDE, 100)
    assert set(led(leases).values()) == {HostPort(OTHER, 7411)}
    meet(domain)
    (again,) = (lease for lease in leases if lease.target == LOCATOR)
    assert again.port == first.port


def test_what_was_forwarded_before_goes_on_until_its_port_is_given_to_somebody() -> None:
    domain = make_domain()
    leases = data_leases_of(domain)
    meet(domain)
    ((port, target),) = led(leases).items()
    domain.heard_inside(dispose_message(A), INSIDE, 100)
    elsewhere = HostPort(OTHER, 7413)
    free = next(p for p in domain.settings.ports.listen.ports() if p not in (port, 45000))
    leases.note_former({port: elsewhere, free: elsewhere})
    assert led(leases) == {port: elsewhere, free: elsewhere}
    meet(domain)
    assert led(leases)[port] == target
    domain.heard_inside(dispose_message(A), INSIDE, 100)
    assert port not in led(leases)
    leases.note_former({})
    assert led(leases) == {}


def test_a_port_at_which_discovery_is_read_is_not_forwarded() -> None:
    """The kernel forwarded discovery to Cyclone DDS, with topics that the policy denies."""
    domain = make_domain()
    leases = data_leases_of(domain)
    domain.heard_inside(of_vendor(spdp(A, INSIDE)), INSIDE, 100)
    assert [lease.kind for _, lease in domain.inside.leases.values()] == [*LeaseKind]
    assert led(leases) == {}


def test_a_participant_that_turns_out_not_to_be_of_fast_dds_is_not_forwarded() -> None:
    domain = make_domain()
    leases = data_leases_of(domain)
    meet(domain)
    assert led(leases)
    domain.heard_inside(of_vendor(spdp(A, INSIDE)), INSIDE, 100)
    assert led(leases) == {}


def test_what_an_older_process_forwarded_to_such_a_port_ends_with_the_participants_return() -> None:
    domain = make_domain()
    leases = data_leases_of(domain)
    port = 45007
    leases.note_former({port: LOCATOR})
    domain.ports.note_forwarded({port: LOCATOR})
    assert led(leases) == {port: LOCATOR}
    domain.heard_inside(of_vendor(spdp(A, INSIDE)), INSIDE, 0.0)
    settle(domain, SETTLING + ANSWER_TIME)
    assert domain.inside.leases[port][1].target == LOCATOR
    assert led(leases) == {}
