"""Fast ports: the second port of each node, and nodes that get or lose this port."""

from hypothesis import given
from hypothesis import strategies as st

from rosproxy.forwarding import fast_ports
from rosproxy.ros1.registry.endpoint import Endpoint, NodeLocation
from rosproxy.ros1.registry.registry import Registry
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortRange


def admitted(registry: Registry, number: int) -> Endpoint:
    node = HostPort("10.0.0.5", 40000 + number)
    return registry.admit(f"http://{node}/", node, NodeLocation(node.host, True), node.host)


def one_admitted(ports: int) -> tuple[Registry, Endpoint]:
    registry = Registry(PortRange(1000, 999 + ports))
    return registry, admitted(registry, 1)


@given(st.integers(1, 60000), st.integers(1, 500))
def test_partners_are_mutual_and_nobody_shares_one(first: int, count: int) -> None:
    ports = PortRange(first, first + count - 1)
    partners = {port: fast_ports.partner(ports, port) for port in ports.ports()}
    lonely = [port for port, other in partners.items() if other is None]
    assert lonely == ([ports.last] if count % 2 else [])
    for port, other in partners.items():
        if other is not None:
            assert other in ports
            assert other != port
            assert partners[other] == port


@given(st.integers(2, 500))
def test_the_first_half_meets_no_fast_port(count: int) -> None:
    ports = PortRange(1000, 999 + count)
    half = [*ports.ports()][: count // 2]
    assert not {fast_ports.partner(ports, port) for port in half} & set(half)


def test_a_port_outside_the_range_has_no_partner() -> None:
    ports = PortRange(1000, 1003)
    assert [fast_ports.partner(ports, port) for port in (999, 1004)] == [None, None]


def test_an_endpoint_gets_the_partner_of_its_lease_and_keeps_it() -> None:
    registry, endpoint = one_admitted(4)
    assert fast_ports.claim(registry.pool, endpoint)
    assert fast_ports.claim(registry.pool, endpoint)
    assert (endpoint.port, endpoint.fast_port) == (1000, 1002)
    assert registry.pool.free == 2
    assert fast_ports.fast_port_count(registry) == 1


def test_a_partner_that_is_a_lease_is_not_to_be_had() -> None:
    registry = Registry(PortRange(1000, 1001))
    first = admitted(registry, 1)
    second = admitted(registry, 2)
    assert not fast_ports.claim(registry.pool, first)
    assert not fast_ports.claim(registry.pool, second)
    assert fast_ports.why_no_fast_port(registry.pool, first) == (
        "the fast port of the node would be 1001, which is in use"
    )


def test_the_odd_last_port_has_none() -> None:
    registry, endpoint = one_admitted(1)
    assert not fast_ports.claim(registry.pool, endpoint)
    assert "port 1000 has no second port" in fast_ports.why_no_fast_port(registry.pool, endpoint)


def test_a_fast_port_is_given_back_once() -> None:
    registry, endpoint = one_admitted(4)
    fast_ports.claim(registry.pool, endpoint)
    for _ in range(2):
        fast_ports.give_back(registry.pool, endpoint)
    assert fast_ports.fast_port_count(registry) == 0
    assert registry.pool.free == 3
    assert "asked for a topic" in fast_ports.why_no_fast_port(registry.pool, endpoint)


def test_a_fast_port_that_another_program_holds_is_blocked() -> None:
    registry, endpoint = one_admitted(4)
    fast_ports.claim(registry.pool, endpoint)
    fast_ports.give_back(registry.pool, endpoint, blocked=True)
    assert registry.pool.blocked == {1002}
    assert registry.pool.free == 2
    assert not fast_ports.claim(registry.pool, endpoint)


def test_the_least_used_fast_port_goes_first() -> None:
    registry = Registry(PortRange(1000, 1005))
    endpoints = [admitted(registry, number) for number in range(3)]
    assert fast_ports.least_used_holder(registry) is None
    for endpoint, count in zip(endpoints, (2, 0, 1), strict=True):
        fast_ports.claim(registry.pool, endpoint)
        endpoint.fast_peers = {"192.0.2.1": count} if count else {}
    given_back = []
    while (holder := fast_ports.least_used_holder(registry)) is not None:
        fast_ports.give_back(registry.pool, holder)
        given_back.append(holder)
    assert given_back == [endpoints[1], endpoints[2], endpoints[0]]
    assert registry.pool.free == 3


def test_whoever_is_connected_through_the_kernel_is_not_idle() -> None:
    registry, endpoint = one_admitted(4)
    endpoint.idle_since = 1.0
    assert [endpoint.unused, endpoint.connected] == [True, False]
    assert registry.longest_idle() is endpoint
    endpoint.fast_peers = {"192.0.2.1": 1}
    assert [endpoint.unused, endpoint.connected] == [False, True]
    assert registry.longest_idle() is None
