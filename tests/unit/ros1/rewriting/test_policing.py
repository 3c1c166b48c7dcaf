"""What of a call the policy is asked about, and what is answered in the master's place."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.access.rules import RuleKind
from rosproxy.leases.ports import PortMap, PortRange
from rosproxy.net.addresses import HostPort
from rosproxy.ros1.protocol.master_methods import Kind, resolve_name
from rosproxy.ros1.protocol.xmlrpc.document import Call
from rosproxy.ros1.registry import hidden_registrations
from rosproxy.ros1.registry.endpoint import Endpoint, NodeLocation, Registration
from rosproxy.ros1.registry.registry import Registry
from rosproxy.ros1.rewriting import policing
from rosproxy.ros1.rewriting.addressing import Addressing
from rosproxy.ros1.rewriting.hidden_graph import with_hidden
from tests.unit.builders import make_stand_ins

PORTS = PortRange(11000, 11009)
OUTSIDE = "http://robot:40001/"


def make(*registrations: tuple[str, Kind, str, bool]) -> Addressing:
    """A registry of nodes at 10.0.0.1, 10.0.0.2, …, each with what it holds and whether hidden."""
    registry = Registry(PORTS)
    for number, (name, kind, resource, is_hidden) in enumerate(registrations, 1):
        address = f"10.0.0.{number}"
        uri = f"http://{address}:1/"
        node = HostPort(address, 1)
        endpoint = registry.admit(uri, node, NodeLocation(address, named=True), address)
        registry.register(endpoint, Registration(kind, resource, name, "T", hidden=is_hidden))
    ports = PortMap(PORTS, PORTS)
    return Addressing(registry, "host", ports, make_stand_ins(ports))


def nodes(endpoints: list[Endpoint]) -> list[str]:
    return [name for endpoint in endpoints for name in endpoint.caller_ids]


@pytest.mark.parametrize(
    ("method", "name", "use"),
    [
        ("getParam", "x", (RuleKind.GET_PARAM, ("/ns/x",), True)),
        ("getParam", "~x", (RuleKind.GET_PARAM, ("/ns/node/x",), True)),
        ("getParam", "/", (RuleKind.GET_PARAM, ("/",), True)),
        ("hasParam", "//a//b/", (RuleKind.GET_PARAM, ("/a/b",), False)),
        ("setParam", "/a", (RuleKind.SET_PARAM, ("/a",), True)),
        ("deleteParam", "a", (RuleKind.SET_PARAM, ("/ns/a",), True)),
        ("searchParam", "/a", (RuleKind.GET_PARAM, ("/a",), False)),
        ("searchParam", "a/b", (RuleKind.GET_PARAM, ("/ns/node/a/b", "/ns/a/b", "/a/b"), False)),
        ("setParam", None, (RuleKind.SET_PARAM, ("/",), True)),
    ],
)
def test_what_a_call_does_with_parameters(
    method: str, name: str | None, use: tuple[RuleKind, tuple[str, ...], bool]
) -> None:
    assert policing.param_use(method, "/ns/node", name) == policing.ParamUse(*use)


def test_other_calls_do_nothing_with_parameters() -> None:
    assert policing.param_use("registerPublisher", "/a", "/b") is None


@given(st.text("/ab~", max_size=8))
def test_a_topic_is_asked_about_in_every_form_that_a_node_may_take_it_for(topic: str) -> None:
    assert {topic, resolve_name(topic, "/ns/x")} <= {*policing.topic_names(topic, "/ns/x")}


def test_a_subscriber_hears_of_hidden_publishers_besides_the_masters() -> None:
    addressing = make(
        ("/shown", Kind.PUBLISHER, "/t", False),
        ("/hidden", Kind.PUBLISHER, "/t", True),
        ("/other", Kind.PUBLISHER, "/u", True),
        ("/listener", Kind.SUBSCRIBER, "/t", False),
    )
    registry = addressing.registry
    shown, concealed, _, listener = registry
    at_master = [OUTSIDE, addressing.advertised_uri(shown)]
    uris = policing.publishers_for(listener, "/t", at_master, addressing)
    assert uris == [*at_master, addressing.advertised_uri(concealed)]
    assert policing.publishers_for(None, "/t", at_master, addressing) == at_master


def test_a_hidden_subscriber_hears_of_those_inside_alone() -> None:
    addressing = make(
        ("/shown", Kind.PUBLISHER, "/t", False),
        ("/hidden", Kind.PUBLISHER, "/t", True),
        ("/listener", Kind.SUBSCRIBER, "/t", True),
    )
    shown, concealed, listener = addressing.registry
    inside = [addressing.advertised_uri(shown), addressing.advertised_uri(concealed)]
    assert policing.publishers_for(listener, "/t", [OUTSIDE], addressing) == inside


def test_what_is_hidden_is_known_by_kind_and_name() -> None:
    addressing = make(
        ("/a", Kind.PUBLISHER, "/t", True),
        ("/b", Kind.SERVICE, "/s", True),
        ("/c", Kind.SERVICE, "/shown", False),
    )
    registry = addressing.registry
    a, b, c = registry
    assert nodes(hidden_registrations.publishers(registry, "/t")) == ["/a"]
    assert hidden_registrations.service(registry, "/s") is b
    assert hidden_registrations.service(registry, "/shown") is None
    assert hidden_registrations.node(registry, "/a") is a
    assert hidden_registrations.node(registry, "/c") is None
    a.health.note_cleaned(1.0)
    assert hidden_registrations.publishers(registry, "/t") == []
    registry.register(b, replace(b.registrations[Kind.SERVICE, "/s", "/b"], hidden=False))
    registry.remove(a)
    assert registry.hidden == {}
    assert c.names_at_master(Kind.SERVICE) == ["/shown"]


@given(
    st.lists(
        st.tuples(st.sampled_from(["/a", "/b", "/c"]), st.sampled_from(["/t", "/u"]), st.booleans())
    )
)
def test_the_index_of_hidden_names_is_that_of_the_registrations(
    steps: list[tuple[str, str, bool]],
) -> None:
    addressing = make()
    registry = addressing.registry
    for caller, topic, is_hidden in steps:
        address = f"10.0.0.{ord(caller[1]) - 96}"
        node = HostPort(address, 1)
        endpoint = registry.admit(f"http://{node}/", node, NodeLocation(address, True), address)
        registration = Registration(Kind.PUBLISHER, topic, caller, hidden=is_hidden)
        registry.register(endpoint, registration)
    wanted = {
        (registration.kind, registration.name, registration.caller_id)
        for _, registration in registry.registrations()
        if registration.hidden
    }
    indexed = {(*key, caller) for key, holders in registry.hidden.items() for caller in holders}
    assert indexed == wanted


def test_the_graph_is_completed_once() -> None:
    addressing = make(
        ("/a", Kind.PUBLISHER, "/t", True),
        ("/b", Kind.SUBSCRIBER, "/only/heard", True),
        ("/c", Kind.SERVICE, "/s", True),
    )
    registry = addressing.registry
    state = [[["/t", ["/far"]]], [], []]
    assert with_hidden(Call("getSystemState", []), state, registry) == [
        [["/t", ["/far", "/a"]]],
        [["/only/heard", ["/b"]]],
        [["/s", ["/c"]]],
    ]
    types = [["/t", "X"]]
    assert with_hidden(Call("getTopicTypes", []), types, registry) == [
        ["/t", "X"],
        ["/only/heard", "T"],
    ]
    assert with_hidden(Call("getPublishedTopics", []), [], registry) == [["/t", "T"]]


@given(st.recursive(st.text() | st.integers(), st.lists))
def test_a_malformed_graph_is_left_as_it_is_or_completed(said: object) -> None:
    registry = make(("/a", Kind.PUBLISHER, "/t", True)).registry
    for method in ("getSystemState", "getTopicTypes", "getPublishedTopics"):
        with_hidden(Call(method, []), said, registry)


def test_what_a_policy_denies_has_a_fix() -> None:
    reason = "policy of --policy: deny call /add"
    answer = policing.no_provider(reason)
    assert answer.triple()[1] == (
        f"no provider (rosproxy: {reason}. Change that rule if the node may have this)"
    )
