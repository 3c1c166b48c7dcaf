"""The registry's tables agree with each other after any sequence of operations."""

from collections import Counter
from typing import Any

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import Endpoint, NodeLocation, Registration
from rosproxy.ros1.registry.registry import RangeExhausted, Registry
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortRange
from rosproxy.shared.uris import slave_uri

PORTS = PortRange(45000, 45005)
ADDRESSES = st.sampled_from(["10.0.0.5", "10.0.0.6", "10.0.0.7"])
SLAVE_PORTS = st.sampled_from([40001, 40002])
NAMES = st.sampled_from(["/a", "/b"])
CALLERS = st.sampled_from(["/n1", "/n2", "/n3"])
KINDS = st.sampled_from(Kind)


class Registries(RuleBasedStateMachine):
    """A registry, and the expected content: the endpoint of each (kind, name, caller)."""

    def __init__(self) -> None:
        super().__init__()
        self.registry = Registry(PORTS)
        self.blocked: set[int] = set()
        self.expected: dict[tuple[Kind, str, str], Endpoint] = {}

    def draw(self, data: st.DataObject) -> Endpoint | None:
        endpoints = list(self.registry)
        return data.draw(st.sampled_from(endpoints)) if endpoints else None

    @rule(
        address=ADDRESSES,
        port=SLAVE_PORTS,
        name=st.sampled_from([None, "node"]),
        source=ADDRESSES,
        confirmed=st.booleans(),
    )
    def admit(
        self, address: str, port: int, name: str | None, source: str, confirmed: bool
    ) -> None:
        node = HostPort(name or address, port)
        place = NodeLocation(address, name is None, confirmed)
        before = {endpoint.slave for endpoint in self.registry}
        try:
            endpoint = self.registry.admit(slave_uri(node), node, place, source)
        except RangeExhausted:
            assert self.registry.pool.free == 0
            assert HostPort(address, port) not in before
        else:
            assert endpoint.slave == HostPort(address, port)
            assert self.registry.admitted(node, source) is endpoint

    @rule(address=ADDRESSES, slave=SLAVE_PORTS, port=st.integers(44999, 45006))
    def restore(self, address: str, slave: int, port: int) -> None:
        node = HostPort(address, slave)
        is_known = any(endpoint.slave == node for endpoint in self.registry)
        usable = port in PORTS and port not in self.registry.by_port and port not in self.blocked
        restored = self.registry.restore(
            slave_uri(node), node, NodeLocation(address, True, False), port
        )
        assert (restored is not None) == (usable and not is_known)
        assert restored is None or restored.port == port

    @rule(data=st.data(), addresses=st.lists(ADDRESSES, min_size=1, max_size=4))
    def move(self, data: st.DataObject, addresses: list[str]) -> None:
        places = {}
        for address in addresses:
            endpoint = self.draw(data)
            if endpoint:
                places[endpoint] = NodeLocation(address, False)
        before = {endpoint: endpoint.slave for endpoint in self.registry}
        admitted = {endpoint: set(endpoint.admissions) for endpoint in self.registry}
        ports = {endpoint: endpoint.port for endpoint in self.registry}
        moved = self.registry.move(places)
        assert {endpoint: endpoint.port for endpoint in self.registry} == ports
        for endpoint, slave in before.items():
            old = slave.host
            port = slave.port
            if endpoint in moved:
                new = places[endpoint].address
                assert endpoint.slave == HostPort(new, port)
                for node in [node for node, source in admitted[endpoint] if source == old]:
                    assert self.registry.admitted(node, new)
                assert self.registry.admitted(endpoint.node, new) in moved
            else:
                assert endpoint.slave == slave
                wanted = places.get(endpoint)
                taken = wanted and self.registry.by_slave.get(HostPort(wanted.address, port))
                assert wanted is None or taken

    @rule(data=st.data())
    def remove(self, data: st.DataObject) -> None:
        endpoint = self.draw(data)
        if endpoint:
            self.registry.remove(endpoint)
            self.expected = {k: e for k, e in self.expected.items() if e is not endpoint}

    @rule(
        data=st.data(),
        kind=KINDS,
        name=NAMES,
        caller_id=CALLERS,
        type_=st.sampled_from(["*", "std_msgs/String"]),
        hidden=st.booleans(),
    )
    def register(
        self,
        data: st.DataObject,
        kind: Kind,
        name: str,
        caller_id: str,
        type_: str,
        hidden: bool,
    ) -> None:
        endpoint = self.draw(data)
        if endpoint is None:
            return
        self.registry.register(endpoint, Registration(kind, name, caller_id, type_, hidden=hidden))
        kept = self.expected.items()
        self.expected = {k: e for k, e in kept if k[2] != caller_id or e is endpoint}
        if kind is Kind.SERVICE:
            kept = self.expected.items()
            self.expected = {k: e for k, e in kept if k[:2] != (kind, name)}
        self.expected[kind, name, caller_id] = endpoint

    @rule(data=st.data(), kind=KINDS, name=NAMES, caller_id=CALLERS)
    def register_too_late(self, data: st.DataObject, kind: Kind, name: str, caller_id: str) -> None:
        """The lease has ended while the proxy asked the node or the master."""
        former = list(self.registry._former.values())
        if former:
            endpoint = data.draw(st.sampled_from(former))
            self.registry.register(endpoint, Registration(kind, name, caller_id))

    @rule(kind=KINDS, name=NAMES, caller_id=CALLERS)
    def unregister(self, kind: Kind, name: str, caller_id: str) -> None:
        self.registry.unregister(kind, name, caller_id)
        self.expected.pop((kind, name, caller_id), None)

    @rule(data=st.data(), caller_id=CALLERS)
    def drop_caller(self, data: st.DataObject, caller_id: str) -> None:
        endpoint = self.draw(data)
        if endpoint:
            self.registry.drop_caller(endpoint, caller_id)
            kept = self.expected.items()
            self.expected = {k: e for k, e in kept if k[2] != caller_id or e is not endpoint}

    @rule(data=st.data())
    def bind_fails(self, data: st.DataObject) -> None:
        """Another program has an endpoint's port: the shell gives both up."""
        endpoint = self.draw(data)
        if endpoint:
            self.registry.pool.block(endpoint.port)
            self.blocked.add(endpoint.port)
            self.registry.remove(endpoint)
            self.expected = {k: e for k, e in self.expected.items() if e is not endpoint}

    @rule(data=st.data())
    def another_program_ends(self, data: st.DataObject) -> None:
        if self.blocked:
            port = data.draw(st.sampled_from(sorted(self.blocked)))
            self.registry.pool.unblock(port)
            self.blocked.discard(port)

    @invariant()
    def every_port_is_free_held_or_blocked(self) -> None:
        pool = self.registry.pool
        leased = set(self.registry.by_port)
        assert pool.free + len(leased) + len(pool.blocked) == len(PORTS)
        assert not leased & self.blocked
        assert all(port in PORTS for port in leased)

    @invariant()
    def every_endpoint_is_found_by_port_and_uri_and_admission(self) -> None:
        for port, endpoint in self.registry.by_port.items():
            assert endpoint.port == port
            assert endpoint in self.registry.by_node(endpoint.node)
            assert endpoint.node == HostPort(endpoint.node.host, endpoint.slave.port)
            for node, source in endpoint.admissions:
                assert self.registry.admitted(node, source) is endpoint
        slaves = {endpoint.slave for endpoint in self.registry}
        assert len(slaves) == len(self.registry)

    @invariant()
    def nobody_else_is_found(self) -> None:
        live = set(self.registry)
        assert set(self.registry.by_slave.values()) == live
        former = set(self.registry._former.values())
        by_node = self.registry._by_node.values()
        assert all(by_node)
        assert sorted(e.port for endpoints in by_node for e in endpoints.values()) == sorted(
            e.port for e in live | former
        )
        assert set(self.registry._admitted.values()) <= live
        assert not former & live
        assert not set(self.registry._former) & set(self.registry.by_port)
        for endpoint in live | former:
            namesakes = self.registry.by_node(endpoint.node)
            assert [e in former for e in namesakes] == sorted(e in former for e in namesakes)
            assert endpoint in namesakes
        last = self.registry._last_port
        assert all(last[endpoint.slave] == endpoint.port for endpoint in live)
        assert len(last) <= len(PORTS)

    @invariant()
    def registrations_are_the_expected_ones(self) -> None:
        registered = {
            registration.key: endpoint for endpoint, registration in self.registry.registrations()
        }
        assert registered == self.expected
        for (kind, name, caller_id), endpoint in self.expected.items():
            assert self.registry.by_caller.get(caller_id) is endpoint
            if kind is Kind.SERVICE:
                service = self.registry.services.get(name)
                assert service
                assert service[0] is endpoint
        assert set(self.registry.by_caller) == {key[2] for key in self.expected}
        for endpoint in self.registry:
            by_caller = {key: caller for caller, keys in endpoint.callers.items() for key in keys}
            assert by_caller == {key: key[2] for key in endpoint.registrations}
            assert all(endpoint.callers.values())
        holders = {
            (kind, name, caller_id): endpoint
            for (kind, name), by_name in self.registry._holders.items()
            for caller_id, endpoint in by_name.items()
        }
        assert holders == self.expected
        assert all(self.registry._holders.values())
        hidden = {r.key: e for e, r in self.registry.registrations() if r.hidden}
        assert {r.key: e for e, r in self.registry.hidden_registrations()} == hidden
        assert all(self.registry._hidden.values())
        counts = Counter[str]()
        characters = Counter[str]()
        for endpoint, registration in self.registry.registrations():
            counts[endpoint.source] += 1
            characters[endpoint.source] += registration.characters
        assert dict(self.registry._registrations_of) == dict(counts)
        assert dict(self.registry._characters_of) == dict(characters)
        services = {key[1] for key in self.expected if key[0] is Kind.SERVICE}
        assert set(self.registry.services) == services


TestRegistries: Any = Registries.TestCase
TestRegistries.settings = settings(stateful_step_count=40)
