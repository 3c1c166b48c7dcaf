"""The registry: endpoints by address and port, leases, registrations."""

from collections.abc import Iterator
from typing import Any

import pytest

from rosproxy.ros1.clients.master_client import read_value
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.protocol.xmlrpc.limits import OWN_REPLY
from rosproxy.ros1.registry.endpoint import (
    LONGEST_REGISTRATION,
    MOST_CALLERS,
    MOST_CHARACTERS,
    MOST_REGISTRATIONS,
    Endpoint,
    NodeLocation,
    Registration,
)
from rosproxy.ros1.registry.node_health import Health
from rosproxy.ros1.registry.registry import MOST_ADMISSIONS, RangeExhausted, Registry
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortRange
from rosproxy.shared.uris import parse_slave_uri
from tests.unit.builders import own_uri, py_reply

PUB = Kind.PUBLISHER
SUB = Kind.SUBSCRIBER
SRV = Kind.SERVICE
PARAM = Kind.PARAM


def make_registry(size: int = 4) -> Registry:
    return Registry(PortRange(45000, 45000 + size - 1))


def admit(
    registry: Registry, uri: str, address: str, source: str | None = None, confirmed: bool = True
) -> Endpoint:
    node = parse_slave_uri(uri)
    assert node
    place = NodeLocation(address, node.host == address, confirmed)
    return registry.admit(uri, node, place, source or address)


def node(registry: Registry, number: int, port: int = 40001) -> Endpoint:
    address = f"10.0.0.{number}"
    return admit(registry, own_uri(address, port), address)


def register(
    registry: Registry, endpoint: Endpoint, kind: Kind, name: str, caller_id: str = "/node"
) -> Registration:
    api = f"rosrpc://{endpoint.node.host}:50001" if kind is SRV else None
    registration = Registration(kind, name, caller_id, service_api=api)
    registry.register(endpoint, registration)
    return registration


def at(uri: str) -> HostPort:
    """Host and port of a URI."""
    address = parse_slave_uri(uri)
    assert address
    return address


def test_an_endpoint_is_keyed_by_address_and_port() -> None:
    registry = make_registry()
    first = node(registry, 5)
    assert node(registry, 5) is first
    assert node(registry, 5, port=40002) is not first
    assert node(registry, 6) is not first
    assert [endpoint.port for endpoint in registry] == [45000, 45001, 45002]
    assert str(first.slave) == "10.0.0.5:40001"
    assert registry.by_port[45000] is first


def test_two_containers_with_the_same_uri_are_two_endpoints() -> None:
    registry = make_registry()
    uri = "http://node:40001/"
    first = admit(registry, uri, "10.0.0.5")
    second = admit(registry, uri, "10.0.0.6")
    assert first is not second
    assert registry.by_node(at(uri)) == [first, second]
    assert registry.admitted(at(uri), "10.0.0.5") is first
    assert registry.admitted(at(uri), "10.0.0.6") is second
    assert registry.admitted(at(uri), "10.0.0.7") is None
    registry.remove(first)
    assert registry.admitted(at(uri), "10.0.0.5") is None
    assert registry.admitted(at(uri), "10.0.0.6") is second


def test_a_node_that_changes_its_uri_keeps_its_lease() -> None:
    registry = make_registry()
    endpoint = admit(registry, "http://c5:40001/", "10.0.0.5")
    assert admit(registry, own_uri("10.0.0.5"), "10.0.0.5") is endpoint
    assert endpoint.uri == own_uri("10.0.0.5")
    assert registry.by_node(at("http://c5:40001/")) == []
    assert registry.by_node(at(own_uri("10.0.0.5"))) == [endpoint]


def test_a_registration_from_another_source_renames_no_endpoint() -> None:
    """Not even with another name of the same host and port."""
    registry = make_registry()
    endpoint = node(registry, 5)
    forged = admit(registry, "http://alias:40001/", "10.0.0.5", "10.0.0.66", confirmed=False)
    assert forged is endpoint
    assert endpoint.uri == own_uri("10.0.0.5")
    assert endpoint.location.confirmed
    assert registry.by_node(at("http://alias:40001/")) == []


def test_an_endpoint_that_was_only_claimed_is_confirmed_by_its_own_address() -> None:
    registry = make_registry()
    endpoint = admit(registry, own_uri("10.0.0.5"), "10.0.0.5", "10.0.0.1", confirmed=False)
    assert not endpoint.location.confirmed
    assert node(registry, 5) is endpoint
    assert endpoint.location.confirmed


def test_a_source_that_means_another_node_by_now_stays_admitted_when_the_old_one_goes() -> None:
    """Removing the old endpoint must not remove the new endpoint's admission."""
    registry = make_registry()
    uri = "http://node:40001/"
    old = admit(registry, uri, "10.0.0.5", "10.0.0.9")
    new = admit(registry, uri, "10.0.0.6", "10.0.0.9")
    registry.remove(old)
    assert registry.admitted(at(uri), "10.0.0.9") is new
    registry.remove(new)
    assert registry.admitted(at(uri), "10.0.0.9") is None


def test_the_same_uri_that_comes_back_gets_the_same_port_while_it_can() -> None:
    registry = make_registry(3)
    first = node(registry, 5)
    second = node(registry, 6)
    registry.remove(first)
    registry.remove(second)
    assert node(registry, 6).port == second.port
    assert node(registry, 5).port == first.port
    registry.remove(registry.by_port[first.port])
    for number in (7, 8):
        node(registry, number)
    with pytest.raises(RangeExhausted):
        node(registry, 5)
    registry.remove(registry.by_port[second.port])
    assert node(registry, 5).port == second.port


def test_a_port_is_used_again_as_late_as_possible() -> None:
    registry = make_registry(3)
    registry.remove(node(registry, 5))
    assert [node(registry, number).port for number in (6, 7, 8)] == [45001, 45002, 45000]


def test_an_exhausted_range_says_what_to_do_and_leaves_no_trace() -> None:
    registry = make_registry(2)
    registry.pool.block(45001)
    node(registry, 5)
    with pytest.raises(RangeExhausted) as caught:
        node(registry, 6)
    for text in ("45000-45001", "1 leases held", "1 taken by other programs", "--port-range"):
        assert text in str(caught.value)
    assert len(registry) == 1
    assert registry.by_node(at(own_uri("10.0.0.6"))) == []
    assert node(registry, 5).port == 45000


def idle(registry: Registry, number: int, since: float | None) -> Endpoint:
    endpoint = node(registry, number)
    endpoint.idle_since = since
    return endpoint


def test_the_endpoint_that_was_idle_longest_is_given_up_first() -> None:
    registry = make_registry()
    idle(registry, 5, 30.0)
    longest = idle(registry, 6, 10.0)
    idle(registry, 7, 20.0)
    assert registry.longest_idle() is longest
    longest.connections = 1
    endpoint = registry.longest_idle()
    assert endpoint
    assert endpoint.node.host == "10.0.0.7"


def test_an_endpoint_that_waits_for_the_masters_reply_is_not_given_up() -> None:
    """An endpoint without a registration is not idle."""
    registry = make_registry()
    node(registry, 5)
    assert registry.longest_idle() is None


def test_registrations_keep_an_endpoint_unless_it_was_cleaned_up() -> None:
    registry = make_registry()
    endpoint = idle(registry, 5, 10.0)
    register(registry, endpoint, PUB, "/a")
    assert endpoint.idle_since is None
    endpoint.idle_since = 20.0
    assert registry.longest_idle() is None
    endpoint.health = Health(failures=2, cleaned=True)
    assert registry.longest_idle() is endpoint
    endpoint.connections = 1
    assert registry.longest_idle() is None
    endpoint.connections = 0
    endpoint.pending = 1
    assert registry.longest_idle() is None


def test_a_call_under_way_keeps_an_endpoint() -> None:
    registry = make_registry()
    endpoint = idle(registry, 5, 10.0)
    endpoint.pending = 1
    assert not endpoint.unused
    assert registry.longest_idle() is None


def test_restored_endpoints_have_the_port_that_they_had() -> None:
    registry = make_registry()
    address = HostPort("10.0.0.5", 40001)
    place = NodeLocation("10.0.0.5", named=True, confirmed=False)
    endpoint = registry.restore(own_uri("10.0.0.5"), address, place, 45002)
    assert endpoint
    assert (endpoint.port, endpoint.trusted) == (45002, False)
    assert registry.admitted(at(own_uri("10.0.0.5")), "10.0.0.5") is endpoint
    other = HostPort("10.0.0.6", 40001), NodeLocation("10.0.0.6", named=True)
    assert registry.restore(own_uri("10.0.0.5"), address, place, 45003) is None  # is there
    assert registry.restore(own_uri("10.0.0.6"), *other, 45002) is None  # port is taken
    assert registry.restore(own_uri("10.0.0.6"), *other, 44000) is None  # not in the range
    assert registry.pool.free == 3


def test_what_is_registered_is_found_by_name_kind_and_endpoint() -> None:
    registry = make_registry()
    endpoint = node(registry, 5)
    for kind, name in [(PUB, "/b"), (PUB, "/a"), (SUB, "/a"), (SRV, "/s"), (PARAM, "/p")]:
        register(registry, endpoint, kind, name)
    assert endpoint.names(PUB) == ["/a", "/b"]
    assert endpoint.names(PARAM) == ["/p"]
    assert endpoint.topics == {"/a", "/b"}
    assert endpoint.caller_ids == ["/node"]
    assert endpoint.label == "/node (http://10.0.0.5:40001/)"
    assert registry.by_caller.get("/node") is endpoint
    assert len(list(registry.registrations())) == 5
    registry.unregister(PUB, "/a", "/node")
    registry.unregister(PUB, "/a", "/node")
    registry.unregister(PUB, "/a", "/somebody")
    assert endpoint.names(PUB) == ["/b"]
    assert endpoint.names(SUB) == ["/a"]


def test_an_endpoint_without_a_name_has_a_label_too() -> None:
    assert node(make_registry(), 5).label == "unnamed node (http://10.0.0.5:40001/)"


def test_a_name_that_registers_from_another_uri_loses_what_it_had() -> None:
    registry = make_registry()
    old = node(registry, 5)
    new = node(registry, 6)
    for kind, name in [(PUB, "/a"), (SRV, "/s"), (PARAM, "/p")]:
        register(registry, old, kind, name)
    register(registry, old, SUB, "/a", "/other")
    register(registry, new, SUB, "/c")
    assert old.caller_ids == ["/other"]
    assert new.names(SUB) == ["/c"]
    assert registry.by_caller.get("/node") is new
    assert registry.services.get("/s") is None


def test_a_service_has_one_provider() -> None:
    registry = make_registry()
    old = node(registry, 5)
    new = node(registry, 6)
    register(registry, old, SRV, "/s", "/old")
    registration = register(registry, new, SRV, "/s", "/new")
    assert registry.services.get("/s") == (new, registration)
    assert old.names(SRV) == []
    registry.unregister(SRV, "/s", "/old")  # too late: another node has the service
    assert registry.services.get("/s") == (new, registration)
    registry.unregister(SRV, "/s", "/new")
    assert registry.services.get("/s") is None


def test_a_service_registered_anew_takes_its_new_uri() -> None:
    registry = make_registry()
    endpoint = node(registry, 5)
    register(registry, endpoint, SRV, "/s")
    again = Registration(SRV, "/s", "/node", service_api="rosrpc://10.0.0.5:50002")
    registry.register(endpoint, again)
    assert registry.services.get("/s") == (endpoint, again)
    assert registry.service_port(endpoint, "/s") == 50002
    assert len(endpoint.registrations) == 1


@pytest.mark.parametrize(
    ("api", "port"),
    [
        ("rosrpc://10.0.0.5:50001", 50001),
        ("rosrpc://somewhere-else:50001", 50001),  # only the port is of use
        (None, None),
        ("nonsense", None),
    ],
)
def test_the_port_of_a_service(api: str | None, port: int | None) -> None:
    registry = make_registry()
    endpoint = admit(registry, own_uri("10.0.0.5"), "10.0.0.5")
    registry.register(endpoint, Registration(SRV, "/s", "/node", service_api=api))
    assert registry.service_port(endpoint, "/s") == port
    assert registry.service_port(node(registry, 6), "/s") is None
    assert registry.service_port(endpoint, "/other") is None
    registry.note_service_port(endpoint, "/s", 50009)
    registry.note_service_port(endpoint, "/other", 50010)
    assert registry.service_port(endpoint, "/s") == 50009
    assert registry.service_port(endpoint, "/other") is None


def test_a_topics_port_is_forgotten_with_the_topic() -> None:
    registry = make_registry()
    endpoint = node(registry, 5)
    for topic in ("/a", "/b"):
        register(registry, endpoint, PUB, topic)
        endpoint.note_topic_port(topic, 50001)
    endpoint.note_topic_port("/not_registered", 50002)
    registry.unregister(PUB, "/a", "/node")
    assert endpoint.topic_ports == {"/b": 50001}


def test_removing_an_endpoint_removes_all_that_it_had() -> None:
    registry = make_registry()
    endpoint = node(registry, 5)
    for kind in Kind:
        register(registry, endpoint, kind, "/a")
    registry.remove(endpoint)
    assert len(registry) == 0
    assert registry.pool.free == 4
    assert registry.by_caller.get("/node") is None
    assert registry.services.get("/a") is None
    assert not endpoint.registrations


def test_a_removed_endpoint_is_known_by_its_uri_until_its_port_is_somebody_elses() -> None:
    registry = make_registry(1)
    endpoint = node(registry, 5)
    registry.remove(endpoint)
    assert registry.by_node(at(own_uri("10.0.0.5"))) == [endpoint]
    node(registry, 6)
    assert registry.by_node(at(own_uri("10.0.0.5"))) == []


def test_endpoints_may_be_removed_while_they_are_gone_through() -> None:
    registry = make_registry()
    for number in (5, 6, 7):
        node(registry, number)
    for endpoint in registry:
        registry.remove(endpoint)
    assert len(registry) == 0


def test_a_node_that_moves_keeps_its_port_and_what_it_calls_itself() -> None:
    registry = make_registry()
    endpoint = node(registry, 5)
    port = 45000
    registration = register(registry, endpoint, PUB, "/a")
    assert registry.move({endpoint: NodeLocation("10.0.0.9", False)}) == [endpoint]
    assert (endpoint.slave, endpoint.port, endpoint.uri) == (
        HostPort("10.0.0.9", 40001),
        port,
        own_uri("10.0.0.5"),
    )
    assert registry.by_slave.get(HostPort("10.0.0.9", 40001)) is endpoint
    assert registry.by_slave.get(HostPort("10.0.0.5", 40001)) is None
    assert registry.admitted(at(own_uri("10.0.0.5")), "10.0.0.9") is endpoint
    assert registry.admitted(at(own_uri("10.0.0.5")), "10.0.0.5") is None
    assert endpoint.registrations == {registration.key: registration}
    another = node(registry, 5)
    assert another is not endpoint
    assert another.port != port


def test_an_admission_by_way_of_a_third_address_stays_when_a_node_moves() -> None:
    registry = make_registry()
    endpoint = admit(registry, own_uri("10.0.0.5"), "10.0.0.5", source="10.0.0.1")
    registry.move({endpoint: NodeLocation("10.0.0.9", False)})
    assert registry.admitted(at(own_uri("10.0.0.5")), "10.0.0.1") is endpoint
    assert registry.admitted(at(own_uri("10.0.0.5")), "10.0.0.9") is endpoint


def test_two_nodes_may_swap_their_addresses() -> None:
    registry = make_registry()
    first = node(registry, 5)
    second = node(registry, 6)
    places = {first: NodeLocation("10.0.0.6", False), second: NodeLocation("10.0.0.5", False)}
    assert registry.move(places) == [first, second]
    assert registry.by_slave.get(HostPort("10.0.0.6", 40001)) is first
    assert registry.by_slave.get(HostPort("10.0.0.5", 40001)) is second
    assert registry.admitted(at(own_uri("10.0.0.5")), "10.0.0.6") is first
    assert registry.admitted(at(own_uri("10.0.0.6")), "10.0.0.5") is second


def test_a_node_whose_new_place_is_held_stays_where_it_was() -> None:
    registry = make_registry()
    first = node(registry, 5)
    holder = node(registry, 6)
    third = node(registry, 7)
    places = {third: NodeLocation("10.0.0.5", False), first: NodeLocation("10.0.0.6", False)}
    assert registry.move(places) == []
    assert [e.location.address for e in (first, holder, third)] == [
        "10.0.0.5",
        "10.0.0.6",
        "10.0.0.7",
    ]
    assert registry.by_slave.get(HostPort("10.0.0.5", 40001)) is first


class Unwalked(dict[Any, Any]):
    """A table in which the proxy may look up, but which it may not go through."""

    def __iter__(self) -> Iterator[Any]:
        raise AssertionError("a walk through all entries")

    values = items = __iter__  # type: ignore[assignment]


def test_nothing_goes_through_all_registrations_for_a_single_name() -> None:
    """To take 1,000 names from a node with 10,000 registrations took 0.5 s."""
    registry = make_registry()
    first = node(registry, 5)
    second = node(registry, 6)
    for caller_id in ("/a", "/b"):
        register(registry, first, PUB, "/t", caller_id)
        register(registry, first, SUB, "/t", caller_id)
    first.registrations = Unwalked(first.registrations)
    subscriptions = registry.subscriptions("/t")
    assert [(e, r.caller_id) for e, r in subscriptions] == [(first, "/a"), (first, "/b")]
    assert registry.holders(PUB, "/t") == {"/a": first, "/b": first}
    register(registry, second, PUB, "/t", "/a")
    assert [r.caller_id for r in first.registrations_of("/b")] == ["/b", "/b"]
    assert registry.holders(PUB, "/t") == {"/a": second, "/b": first}


def test_an_endpoint_has_so_many_registrations_at_most() -> None:
    registry = make_registry()
    endpoint = node(registry, 5)
    for number in range(MOST_REGISTRATIONS + 10):
        register(registry, endpoint, PUB, f"/t{number}")
    assert len(endpoint.registrations_of("/node")) == MOST_REGISTRATIONS
    assert "10000 registrations, at most 10000" in (endpoint.reason_full("/node") or "")
    registration = Registration(PUB, "/t0", "/node", "std_msgs/String")
    registry.register(endpoint, registration)
    assert endpoint.registrations[registration.key] is registration
    registry.unregister(PUB, "/t0", "/node")
    assert endpoint.reason_full("/node") is None


def test_an_endpoint_has_so_many_characters_of_names_at_most() -> None:
    registry = make_registry()
    endpoint = node(registry, 5)
    for number in range(2 * MOST_CHARACTERS // 1000):
        register(registry, endpoint, SRV, f"/{number}".ljust(1000, "x"), "/node")
    assert MOST_CHARACTERS <= endpoint.characters < MOST_CHARACTERS + 1100
    assert "characters of registered names" in (endpoint.reason_full("/node") or "")
    registry.drop_caller(endpoint, "/node")
    assert (endpoint.characters, endpoint.reason_full("/node")) == (0, None)


@pytest.mark.parametrize(
    ("bound", "most", "label"),
    [
        ("MOST_REGISTRATIONS_IN_ALL", 11, "4 registrations, and leave 4 to others"),
        ("MOST_CHARACTERS_IN_ALL", 150, "56 characters of names, and leave 52 to others"),
    ],
)
def test_a_source_gets_no_more_registrations_than_it_leaves_to_others(
    monkeypatch: pytest.MonkeyPatch, bound: str, most: int, label: str
) -> None:
    """A container with a node at each of 100 ports filled the memory of its proxy."""
    monkeypatch.setattr(f"rosproxy.ros1.registry.registry.{bound}", most)
    registry = make_registry()
    other = node(registry, 6)
    first, second = (node(registry, 5, port) for port in (40001, 40002))
    for number in range(3):
        for endpoint in (other, first, second):
            register(registry, endpoint, PUB, f"/t{number}", f"/node{endpoint.port}")
    assert (len(first.registrations), len(second.registrations)) == (2, 2)
    assert len(other.registrations) == 3
    reason = registry.reason_full(second, Registration(PUB, "/new", "/n")) or ""
    assert label in reason
    assert "not accepted. Run some of these nodes at another address" in reason
    assert registry.reason_full(other, Registration(PUB, "/new", "/n")) is None
    register(registry, first, PUB, "/t0", f"/node{first.port}")
    registry.remove(second)
    assert registry.reason_full(first, Registration(PUB, "/new", "/n")) is None
    registry.remove(first)
    registry.remove(other)
    assert not registry._registrations_of + registry._characters_of
    assert (registry._registrations, registry._characters) == (0, 0)


@pytest.mark.parametrize("padding", [0, 140])
def test_the_proxy_can_read_the_state_of_the_master_with_all_registrations(padding: int) -> None:
    """The nodes of an address registered so much that the proxy treated the master as down.

    A proxy that started then let no other node register.
    """
    registry = make_registry(32)
    for number in range(32):
        endpoint = node(registry, 5 + number // 8, 40001 + number)
        for count in range(MOST_REGISTRATIONS):
            name = f"/{number}/{count}".ljust(padding, "&")
            if not registry.reason_full(endpoint, Registration(PUB, name, f"/n{number}")):
                register(registry, endpoint, PUB, name, f"/n{number}")
    names = [r.name for e in registry for r in e.registrations.values()]
    assert len(names) > 20_000
    state = [[[name, ["/n00"]] for name in names], [], []]
    assert read_value("getSystemState", py_reply([1, "", state]), OWN_REPLY) == state


@pytest.mark.parametrize("bound", ["MOST_REGISTRATIONS_IN_ALL", "MOST_CHARACTERS_IN_ALL"])
def test_all_accepted_registrations_return_after_a_restart(
    monkeypatch: pytest.MonkeyPatch, bound: str
) -> None:
    """The master lists nodes in another order than they registered in.

    Of two containers, the first could have 20,000 registrations and the second 12,500. Read in the
    other order, the first lost 3,750 of these.
    """
    monkeypatch.setattr(f"rosproxy.ros1.registry.registry.{bound}", 700)
    before = make_registry()
    for number, count in ((5, 300), (6, 300)):
        endpoint = node(before, number)
        for topic in range(count):
            registration = Registration(PUB, f"/{number}/{topic}", f"/n{number}")
            if not before.reason_full(endpoint, registration):
                before.register(endpoint, registration)
    after = make_registry()
    for endpoint in reversed(list(before)):
        restored = after.restore(endpoint.uri, endpoint.node, endpoint.location, endpoint.port)
        assert restored is not None
        for registration in endpoint.registrations.values():
            after.register(restored, registration)
        assert len(restored.registrations) == len(endpoint.registrations)


def test_a_thousand_nodes_of_an_address_may_have_long_names() -> None:
    """These nodes got no more than 16,500 registrations of 150 characters."""
    registry = make_registry(1000)
    for number in range(1000):
        caller_id = f"/warehouse_a/robot_{number:03}/move_base_flex"
        endpoint = node(registry, 5, 40001 + number)
        for count in range(20):
            name = f"{caller_id}/global_costmap/obstacle_layer_{count:02}/parameter_updates"
            registration = Registration(PUB, name, caller_id, "dynamic_reconfigure/Config")
            assert registry.reason_full(endpoint, registration) is None
            registry.register(endpoint, registration)


def test_an_endpoint_has_so_many_node_names_at_most() -> None:
    """The policy judges a topic for each name: 2 s for 10,000 names and 100 rules."""
    registry = make_registry()
    endpoint = node(registry, 5)
    for number in range(MOST_CALLERS + 10):
        register(registry, endpoint, PUB, "/t", f"/n{number}")
    assert endpoint.caller_ids == sorted(f"/n{number}" for number in range(MOST_CALLERS))
    reason = endpoint.reason_full("/another") or ""
    assert "64 node names, at most 64 are accepted. Start the node with the same name" in reason
    assert endpoint.reason_full("/n0") is None


def full_endpoint(registry: Registry) -> Endpoint:
    """An endpoint with two registrations fewer than it may have."""
    endpoint = node(registry, 5)
    for number in range(MOST_REGISTRATIONS - 2):
        register(registry, endpoint, PUB, f"/t{number}")
    return endpoint


def test_a_full_endpoint_accepts_what_it_has_already() -> None:
    """A node with the highest number of registrations was refused at a master that restarted."""
    registry = make_registry()
    endpoint = full_endpoint(registry)
    for number in range(2):
        register(registry, endpoint, PUB, f"/more{number}")
    assert registry.reason_full(endpoint, Registration(PUB, "/t0", "/node")) is None
    longer = Registration(PUB, "/t0", "/node", "std_msgs/String")
    assert registry.reason_full(endpoint, longer) is None
    assert registry.reason_full(endpoint, Registration(SUB, "/t0", "/node"))
    endpoint.characters = MOST_CHARACTERS
    assert registry.reason_full(endpoint, longer)
    assert registry.reason_full(endpoint, Registration(PUB, "/t0", "/node")) is None


def test_admitted_registrations_take_room_until_they_are_recorded() -> None:
    """A system.multicall of 1,000 registrations found room for each of these."""
    registry = make_registry()
    endpoint = full_endpoint(registry)
    admitted = [Registration(PUB, f"/more{number}", "/node") for number in range(2)]
    for registration in admitted:
        assert registry.reason_full(endpoint, registration) is None
        registry.promise(endpoint, registration)
    assert registry.reason_full(endpoint, Registration(PUB, "/else", "/node"))
    for registration in admitted:
        registry.register(endpoint, registration)
        registry.end_promise(endpoint, registration)
    assert len(endpoint.registrations) == MOST_REGISTRATIONS
    assert not endpoint.promised + registry._promised_of + registry._promised_characters_of
    assert endpoint.promised_characters == 0


def test_admitted_registrations_that_fail_leave_their_room() -> None:
    registry = make_registry()
    endpoint = node(registry, 5)
    admitted = [Registration(PUB, "/t", f"/n{number}") for number in range(MOST_CALLERS)]
    for registration in admitted:
        assert registry.reason_full(endpoint, registration) is None
        registry.promise(endpoint, registration)
    assert registry.reason_full(endpoint, Registration(PUB, "/t", "/next"))
    for registration in admitted:
        registry.end_promise(endpoint, registration)
    assert registry.reason_full(endpoint, Registration(PUB, "/t", "/next")) is None


def test_a_registration_that_is_too_long_is_not_kept() -> None:
    registry = make_registry()
    endpoint = node(registry, 5)
    register(registry, endpoint, PUB, "/" + "x" * LONGEST_REGISTRATION)
    assert not endpoint.registrations
    assert not registry.by_caller


def test_an_endpoint_of_many_nodes_has_a_short_label() -> None:
    registry = make_registry()
    endpoint = node(registry, 5)
    for number in range(1000):
        register(registry, endpoint, PUB, "/t", f"/n{number}")
    assert endpoint.label == "/n0, /n1, /n10 and 61 more (http://10.0.0.5:40001/)"
    assert endpoint.log_fields["node"] == "/n0, /n1, /n10 and 61 more"


def failing(
    registry: Registry, number: int, source: int, proven: bool = False, failures: int = 1
) -> Endpoint:
    """A node that an address registered and that does not answer any more, or never did."""
    address = f"10.0.0.{number}"
    endpoint = admit(registry, own_uri(address), address, f"10.0.0.{source}")
    endpoint.health.answered_at = 1.0 if proven else None
    endpoint.health.failures = failures
    endpoint.health.failing_since = float(number)
    register(registry, endpoint, PUB, f"/topic{number}", f"/node{number}")
    return endpoint


def given_up(registry: Registry) -> list[str]:
    """The endpoints that give way to live nodes, in order."""
    hosts = []
    while (endpoint := registry.dead_endpoint()) is not None:
        hosts.append(endpoint.location.address.removeprefix("10.0.0."))
        registry.remove(endpoint)
    return hosts


def test_the_dead_give_way_in_order() -> None:
    registry = make_registry(16)
    node(registry, 1)  # just admitted: not probed yet
    failing(registry, 2, source=2, proven=True)  # may come back after a single failure
    silent = failing(registry, 3, source=3, proven=True, failures=2)
    ended = failing(registry, 4, source=4, proven=True, failures=2)
    ended.health.refused = True
    failing(registry, 5, source=5, proven=True, failures=2).pending = 1
    failing(registry, 6, source=6, proven=True, failures=2).connections = 1
    failing(registry, 7, source=90)
    for number in (8, 9, 10):
        failing(registry, number, source=91)
    assert given_up(registry) == ["8", "9", "7", "10", "4", "3"]
    assert silent not in registry
    assert len(registry) == 4


def test_what_only_the_master_tells_of_gives_way_once_it_was_asked_in_vain() -> None:
    registry = make_registry()
    address = HostPort("10.0.0.5", 40001)
    place = NodeLocation("10.0.0.5", named=True, confirmed=False)
    claim = registry.restore(own_uri("10.0.0.5"), address, place, 45000)
    assert claim
    register(registry, claim, PUB, "/a")
    assert registry.dead_endpoint() is None  # the proxy is asking the node
    claim.health.failures = 1
    assert registry.dead_endpoint() is claim
    # something answers that is not the node
    claim.health.failures = 0
    claim.health.answered_at = 5.0
    assert registry.dead_endpoint() is claim
    claim.trusted = True
    assert registry.dead_endpoint() is None


def test_nodes_of_a_source_that_never_answered() -> None:
    registry = make_registry(8)
    first = admit(registry, own_uri("10.0.0.5"), "10.0.0.5", "10.0.0.9")
    second = admit(registry, own_uri("10.0.0.6"), "10.0.0.6", "10.0.0.9")
    node(registry, 7)
    assert registry.unproven("10.0.0.9") == [first, second]
    first.health.answered_at = 1.0
    assert registry.unproven("10.0.0.9") == [second]
    assert [make_registry(size).most_unproven for size in (1, 4, 8, 100)] == [1, 1, 2, 25]


def test_few_uris_are_remembered_for_one_endpoint_and_the_oldest_go() -> None:
    registry = make_registry()
    uris = [f"http://name{number}:40001/" for number in range(MOST_ADMISSIONS + 2)]
    endpoints = {admit(registry, uri, "10.0.0.5") for uri in uris}
    (endpoint,) = endpoints
    remembered = [uri for uri in uris if registry.admitted(at(uri), "10.0.0.5") is endpoint]
    assert remembered == uris[2:]
    assert len(endpoint.admissions) == MOST_ADMISSIONS
    admit(registry, uris[2], "10.0.0.5")  # used again: now the newest
    admit(registry, uris[0], "10.0.0.5")
    assert registry.admitted(at(uris[2]), "10.0.0.5") is endpoint
    assert registry.admitted(at(uris[3]), "10.0.0.5") is None
    registry.remove(endpoint)
    assert not any(registry.admitted(at(uri), "10.0.0.5") for uri in uris)
