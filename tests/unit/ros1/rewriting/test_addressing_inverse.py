"""Import and export are inverses for every URI handed out, in any topology."""

from dataclasses import dataclass

from hypothesis import given
from hypothesis import strategies as st

from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import Endpoint, NodeLocation, Registration
from rosproxy.ros1.registry.remembered_leases import leases_text, read_leases
from rosproxy.ros1.rewriting.addressing import Addressing, Caller
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.uris import parse_service_uri, parse_slave_uri, service_uri, slave_uri
from tests.unit.builders import make_addressing

ADDRESSES = st.sampled_from(
    ["10.0.0.5", "10.0.0.6", "10.0.1.5", "10.0.1.6", "172.20.0.2", "fd00::5", "fd00::6", "fd01::5"]
)
NAMES = st.sampled_from(["node", "c5", "localhost", "127.0.0.1", "::1", "Größe", "10.0.0.5"])
SLAVE_PORTS = st.integers(40001, 40003)
NETWORKS = st.lists(
    st.sampled_from(["10.0.0.0/24", "10.0.0.0/8", "172.20.0.0/16", "fd00::/64", "fd00::/8"]),
    max_size=3,
)
PROXIES = st.sampled_from(["10.0.0.1", "10.0.1.1", "172.20.0.1", "fd00::1", "fd01::1"])
HOSTS = st.sampled_from(["robot-host", "Robot_2.example.com", "192.168.1.5", "fd99::1"])
OFFSETS = st.sampled_from([0, -15000, 5, 100])


@dataclass(frozen=True)
class Member:
    """A node of a random topology: address, own name, port, host of its service."""

    address: str
    name: str | None
    port: int
    named: bool
    service_host: str | None

    def join(self, addressing: Addressing) -> Endpoint:
        node = HostPort(self.name or self.address, self.port)
        named = self.named or node.host == self.address
        place = NodeLocation(self.address, named)
        endpoint = addressing.registry.admit(slave_uri(node), node, place, self.address)
        caller_id = f"/n{len(addressing.registry)}"
        api = service_uri(HostPort(self.service_host or node.host, 50000 + endpoint.port % 100))
        for registration in (
            Registration(Kind.PUBLISHER, "/topic", caller_id),
            Registration(Kind.SERVICE, f"/s{endpoint.port}", caller_id, service_api=api),
        ):
            addressing.registry.register(endpoint, registration)
        return endpoint


MEMBERS = st.builds(
    Member, ADDRESSES, st.none() | NAMES, SLAVE_PORTS, st.booleans(), st.none() | NAMES
)


@st.composite
def topologies(draw: st.DrawFn, distinct: bool = False) -> tuple[Addressing, list[Endpoint]]:
    """A proxy with nodes behind. With ``distinct`` no two nodes have the same host and port."""
    first = 45000 + draw(OFFSETS)
    addressing = make_addressing(draw(HOSTS), (45000, 45009), (first, first + 9), draw(NETWORKS))
    members = draw(
        st.lists(MEMBERS, min_size=1, max_size=7, unique_by=lambda m: (m.address, m.port))
    )
    for member in members:
        called = HostPort(member.name or member.address, member.port)
        if not (distinct and addressing.registry.by_node(called)):
            member.join(addressing)
    return addressing, list(addressing.registry)


@st.composite
def callers(draw: st.DrawFn, addressing: Addressing) -> tuple[Caller, Caller]:
    """A caller twice: when the proxy hands out addresses, and when the caller sends them back."""
    proxy = draw(PROXIES)
    endpoint = draw(st.none() | st.sampled_from(list(addressing.registry)))
    address = endpoint.location.address if endpoint else draw(ADDRESSES)
    plain = Caller(address, proxy)
    return draw(st.sampled_from([plain, Caller(address, proxy, endpoint=endpoint)])), plain


@given(topologies(), st.data())
def test_a_slave_uri_handed_out_comes_back_as_it_was(
    topology: tuple[Addressing, list[Endpoint]], data: st.DataObject
) -> None:
    addressing, endpoints = topology
    given, back = data.draw(callers(addressing))
    for endpoint in endpoints:
        outside = addressing.advertised_uri(endpoint)
        inside = addressing.import_slave(outside, given)
        assert addressing.export_slave(inside, back) == outside
        assert inside == endpoint.uri or addressing.is_own_uri(inside, back)
        assert parse_slave_uri(inside)


@given(topologies(), st.data())
def test_a_node_is_given_its_own_uri_literally(
    topology: tuple[Addressing, list[Endpoint]], data: st.DataObject
) -> None:
    addressing, endpoints = topology
    endpoint = data.draw(st.sampled_from(endpoints))
    outside = addressing.advertised_uri(endpoint)
    for caller in (
        Caller(endpoint.location.address, "10.0.0.1"),
        Caller(endpoint.location.address, "10.0.0.1", endpoint=endpoint),
    ):
        assert addressing.import_slave(outside, caller) == endpoint.uri
        assert addressing.export_slave(endpoint.uri, caller) == outside


@given(topologies(distinct=True), st.data())
def test_a_uri_comes_back_as_it_was_after_its_node_has_gone(
    topology: tuple[Addressing, list[Endpoint]], data: st.DataObject
) -> None:
    addressing, endpoints = topology
    given, back = data.draw(callers(addressing))
    outside = [addressing.advertised_uri(endpoint) for endpoint in endpoints]
    inside = [addressing.import_slave(uri, given) for uri in outside]
    for endpoint in data.draw(st.lists(st.sampled_from(endpoints), unique_by=id)):
        addressing.registry.remove(endpoint)
    assert [addressing.export_slave(uri, back) for uri in inside] == outside
    again = [addressing.import_slave(uri, back) for uri in outside]
    assert [addressing.export_slave(uri, back) for uri in again] == outside


@given(topologies(), st.data())
def test_a_service_uri_handed_out_comes_back_as_it_was(
    topology: tuple[Addressing, list[Endpoint]], data: st.DataObject
) -> None:
    addressing, endpoints = topology
    given, back = data.draw(callers(addressing))
    for endpoint in endpoints:
        outside = addressing.advertised_service(endpoint)
        for name in (f"/s{endpoint.port}", "/unknown"):
            inside = addressing.import_service(outside, name, given)
            assert addressing.export_service(inside, name, back) == outside
            assert parse_service_uri(inside)


@given(topologies(), st.data())
def test_outside_uris_pass_both_ways(
    topology: tuple[Addressing, list[Endpoint]], data: st.DataObject
) -> None:
    addressing, _ = topology
    caller, _ = data.draw(callers(addressing))
    host = data.draw(st.sampled_from(["laptop", "192.168.1.77", addressing.host]))
    uri = slave_uri(HostPort(host, data.draw(st.integers(1024, 29000))))
    assert addressing.import_slave(uri, caller) == uri
    assert addressing.export_slave(uri, caller) == uri


@given(topologies())
def test_the_master_can_be_asked_for_all_that_a_restarted_proxy_needs(
    topology: tuple[Addressing, list[Endpoint]],
) -> None:
    addressing, endpoints = topology
    text = leases_text(endpoints, addressing.ports)
    memory = read_leases(text, addressing.ports)
    for endpoint in endpoints:
        port = addressing.lease_of(addressing.advertised_uri(endpoint))
        assert port == endpoint.port
        inside = memory[port].node

        assert inside.node == endpoint.node
        assert inside.slave == endpoint.slave
