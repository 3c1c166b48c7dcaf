"""The policy's checks of a call, and the proxy's answers in the master's place."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.ros1.policy.checks import topic_names
from rosproxy.ros1.policy.denial import no_provider
from rosproxy.ros1.policy.hidden import HiddenAnswers
from rosproxy.ros1.policy.parameters import ParamUse, param_use
from rosproxy.ros1.protocol.master_methods import Kind, resolve_name
from rosproxy.ros1.protocol.xmlrpc.document import Call
from rosproxy.ros1.registry.endpoint import NodeLocation, Registration
from rosproxy.ros1.registry.registry import Registry
from rosproxy.ros1.rewriting.addressing import Addressing, Caller
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.policy.rules import RuleKind
from rosproxy.shared.ports import PortMap, PortRange
from tests.unit.builders import make_stand_ins

PORTS = PortRange(11000, 11009)
OUTSIDE = "http://robot:40001/"


def make(*registrations: tuple[str, Kind, str, bool]) -> Addressing:
    """A registry of nodes at 10.0.0.1, 10.0.0.2, …, each with a registration that may be hidden."""
    registry = Registry(PORTS)
    for number, (name, kind, resource, is_hidden) in enumerate(registrations, 1):
        address = f"10.0.0.{number}"
        uri = f"http://{address}:1/"
        node = HostPort(address, 1)
        endpoint = registry.admit(uri, node, NodeLocation(address, named=True), address)
        registry.register(endpoint, Registration(kind, resource, name, "T", hidden=is_hidden))
    ports = PortMap(PORTS, PORTS)
    return Addressing(registry, "host", ports, make_stand_ins(ports))


def hidden_in(addressing: Addressing) -> HiddenAnswers:
    return HiddenAnswers(addressing.registry, addressing)


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
    assert param_use(method, "/ns/node", name) == ParamUse(*use)


def test_other_calls_do_nothing_with_parameters() -> None:
    assert param_use("registerPublisher", "/a", "/b") is None


@given(st.text("/ab~", max_size=8))
def test_a_topic_is_asked_about_in_every_form_that_a_node_may_take_it_for(topic: str) -> None:
    assert {topic, resolve_name(topic, "/ns/x")} <= {*topic_names(topic, "/ns/x")}


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
    uris = hidden_in(addressing).publishers_for(listener, "/t", at_master)
    assert uris == [*at_master, addressing.advertised_uri(concealed)]


def test_a_hidden_subscriber_hears_of_those_inside_alone() -> None:
    addressing = make(
        ("/shown", Kind.PUBLISHER, "/t", False),
        ("/hidden", Kind.PUBLISHER, "/t", True),
        ("/listener", Kind.SUBSCRIBER, "/t", True),
    )
    shown, concealed, listener = addressing.registry
    inside = [addressing.advertised_uri(shown), addressing.advertised_uri(concealed)]
    assert hidden_in(addressing).publishers_for(listener, "/t", [OUTSIDE]) == inside


def test_what_is_hidden_is_known_by_kind_and_name() -> None:
    addressing = make(
        ("/a", Kind.PUBLISHER, "/t", True),
        ("/b", Kind.SERVICE, "/s", True),
        ("/c", Kind.SERVICE, "/shown", False),
    )
    registry = addressing.registry
    a, b, c = registry
    hidden = hidden_in(addressing)
    caller = Caller("10.0.0.9", "10.0.0.100")
    assert dict(registry.hidden_holders(Kind.PUBLISHER, "/t")) == {"/a": a}
    assert [(e, r.name) for e, r in registry.hidden_registrations()] == [(a, "/t"), (b, "/s")]
    assert hidden.find_node("/a", caller)
    assert hidden.find_node("/c", caller) is None
    a.health.note_cleaned(1.0)
    assert hidden.find_node("/a", caller) is None
    assert hidden.publishers_for(c, "/t", []) == []
    registry.register(b, replace(b.registrations[Kind.SERVICE, "/s", "/b"], hidden=False))
    registry.remove(a)
    assert not registry.has_hidden
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
        registration.key for _, registration in registry.registrations() if registration.hidden
    }
    assert {registration.key for _, registration in registry.hidden_registrations()} == wanted


def test_the_graph_is_completed_once() -> None:
    addressing = make(
        ("/a", Kind.PUBLISHER, "/t", True),
        ("/b", Kind.SUBSCRIBER, "/only/heard", True),
        ("/c", Kind.SERVICE, "/s", True),
    )
    hidden = hidden_in(addressing)
    state = [[["/t", ["/far"]]], [], []]
    assert hidden.complete_graph(Call("getSystemState", []), state) == [
        [["/t", ["/far", "/a"]]],
        [["/only/heard", ["/b"]]],
        [["/s", ["/c"]]],
    ]
    types = [["/t", "X"]]
    assert hidden.complete_graph(Call("getTopicTypes", []), types) == [
        ["/t", "X"],
        ["/only/heard", "T"],
    ]
    assert hidden.complete_graph(Call("getPublishedTopics", []), []) == [["/t", "T"]]


class Compared(str):
    """A name that counts comparisons with other names."""

    compared = 0

    def __eq__(self, other: object) -> bool:
        Compared.compared += 1
        return str.__eq__(self, other)

    __hash__ = str.__hash__


def test_the_graph_compares_no_hidden_name_with_all_others() -> None:
    """The graph with 10,000 hidden publishers of a topic took 1.8 s."""
    addressing = make(("/shown", Kind.PUBLISHER, "/t", False))
    (endpoint,) = addressing.registry
    names = [Compared(f"/n{number}") for number in range(60)]
    for name in names:
        addressing.registry.register(
            endpoint, Registration(Kind.PUBLISHER, "/t", name, hidden=True)
        )
    Compared.compared = 0
    state: list[list[object]] = [[["/t", ["/shown"]]], [], []]
    graph = hidden_in(addressing).complete_graph(Call("getSystemState", []), state)
    assert graph == [[["/t", ["/shown", *map(str, names)]]], [], []]
    assert Compared.compared < 5 * len(names)


@given(st.recursive(st.text() | st.integers(), st.lists))
def test_a_malformed_graph_is_left_as_it_is_or_completed(said: object) -> None:
    hidden = hidden_in(make(("/a", Kind.PUBLISHER, "/t", True)))
    for method in ("getSystemState", "getTopicTypes", "getPublishedTopics"):
        hidden.complete_graph(Call(method, []), said)


def test_what_a_policy_denies_has_a_fix() -> None:
    reason = "policy of --policy: deny call /add"
    denial = no_provider(reason)
    assert denial.reason == reason
    assert denial.answer.triple()[1] == (
        f"no provider (rosproxy: {reason}. Change that rule if the node may have this)"
    )
