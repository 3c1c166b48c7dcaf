"""Ports that the kernel may forward: ports of user data, and ports from before the start."""

from rosproxy.forwarding.kernel.decisions import HostForwarding, destination
from rosproxy.ros2.discovery.domain import Domain
from rosproxy.ros2.ports.former_ports import ANSWER_TIMEOUT_S
from rosproxy.ros2.ports.kernel_ports import KernelPorts
from rosproxy.ros2.ports.locator_ports import SETTLING_PERIOD_S
from rosproxy.ros2.registry.participants import TrafficKind
from rosproxy.shared.addresses import HostPort, Route
from rosproxy.shared.ports import PortPool
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


def kernel_ports_of(domain: Domain) -> KernelPorts:
    kernel_ports = KernelPorts(PortPool(domain.settings.ports.listen))
    kernel_ports.domains.append(domain.mappings)
    return kernel_ports


def led(kernel_ports: KernelPorts) -> dict[int, HostPort]:
    return {forwarded.port: forwarded.target for forwarded in kernel_ports}


def test_only_user_data_is_forwarded() -> None:
    domain = make_domain()
    kernel_ports = kernel_ports_of(domain)
    assert led(kernel_ports) == {}
    meet(domain)
    ((port, target),) = led(kernel_ports).items()
    assert target == LOCATOR
    assert domain.mappings.by_port[port][1].kind is TrafficKind.USER_DATA
    (forwarded,) = kernel_ports
    assert destination(forwarded, HostForwarding(), Route("172.30.0.2", 1500), False) == LOCATOR
    assert destination(forwarded, HostForwarding(), Route(INSIDE, 1500), False) != LOCATOR


def test_a_locator_that_turns_out_to_be_of_metatraffic_is_not_forwarded() -> None:
    domain = make_domain()
    kernel_ports = kernel_ports_of(domain)
    meet(domain)
    (forwarded,) = kernel_ports
    domain.heard_inside(spdp(A, INSIDE, LOCATOR.port), INSIDE, 100)
    assert forwarded.port not in led(kernel_ports)


def test_who_keeps_a_lease_is_the_same_and_who_comes_after_is_not() -> None:
    domain = make_domain()
    kernel_ports = kernel_ports_of(domain)
    meet(domain)
    (first,) = kernel_ports
    meet(domain, B, OTHER)
    assert [forwarded for forwarded in kernel_ports if forwarded is first]
    domain.heard_inside(dispose_message(A), INSIDE, 100)
    assert set(led(kernel_ports).values()) == {HostPort(OTHER, 7411)}
    meet(domain)
    (again,) = (forwarded for forwarded in kernel_ports if forwarded.target == LOCATOR)
    assert again.port == first.port


def test_what_was_forwarded_before_goes_on_until_its_port_is_given_to_somebody() -> None:
    domain = make_domain()
    kernel_ports = kernel_ports_of(domain)
    meet(domain)
    ((port, target),) = led(kernel_ports).items()
    domain.heard_inside(dispose_message(A), INSIDE, 100)
    elsewhere = HostPort(OTHER, 7413)
    free = next(p for p in domain.settings.ports.listen.ports() if p not in (port, 45000))
    kernel_ports.note_former({port: elsewhere, free: elsewhere})
    assert led(kernel_ports) == {port: elsewhere, free: elsewhere}
    meet(domain)
    assert led(kernel_ports)[port] == target
    domain.heard_inside(dispose_message(A), INSIDE, 100)
    assert port not in led(kernel_ports)
    kernel_ports.note_former({})
    assert led(kernel_ports) == {}


def test_a_port_at_which_discovery_is_read_is_not_forwarded() -> None:
    """The kernel forwarded discovery to Cyclone DDS, with topics that the policy denies."""
    domain = make_domain()
    kernel_ports = kernel_ports_of(domain)
    domain.heard_inside(of_vendor(spdp(A, INSIDE)), INSIDE, 100)
    assert [forwarded.kind for _, forwarded in domain.mappings.by_port.values()] == [*TrafficKind]
    assert led(kernel_ports) == {}


def test_a_participant_that_turns_out_not_to_be_of_fast_dds_is_not_forwarded() -> None:
    domain = make_domain()
    kernel_ports = kernel_ports_of(domain)
    meet(domain)
    assert led(kernel_ports)
    domain.heard_inside(of_vendor(spdp(A, INSIDE)), INSIDE, 100)
    assert led(kernel_ports) == {}


def test_what_an_older_process_forwarded_to_such_a_port_ends_with_the_participants_return() -> None:
    domain = make_domain()
    kernel_ports = kernel_ports_of(domain)
    port = 45007
    kernel_ports.note_former({port: LOCATOR})
    domain.ports.note_forwarded({port: LOCATOR})
    assert led(kernel_ports) == {port: LOCATOR}
    domain.heard_inside(of_vendor(spdp(A, INSIDE)), INSIDE, 0.0)
    settle(domain, SETTLING_PERIOD_S + ANSWER_TIMEOUT_S)
    assert domain.mappings.by_port[port][1].target == LOCATOR
    assert led(kernel_ports) == {}


def test_what_an_older_process_forwarded_to_discovery_ends() -> None:
    """The kernel led a former port for user data to the new participant's port for discovery."""
    domain = make_domain()
    kernel_ports = kernel_ports_of(domain)
    port = 45007
    discovery = HostPort(INSIDE, 7410)
    kernel_ports.note_former({port: discovery})
    domain.ports.note_forwarded({port: discovery})
    assert led(kernel_ports) == {port: discovery}
    domain.heard_inside(of_vendor(spdp(A, INSIDE)), INSIDE, 0.0)
    settle(domain, SETTLING_PERIOD_S + ANSWER_TIMEOUT_S)
    assert port not in domain.mappings.by_port
    assert led(kernel_ports) == {}
