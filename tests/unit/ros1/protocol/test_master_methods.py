"""The table of master methods against DESIGN's rows, and how the master resolves names."""

import pytest

from rosproxy.ros1.protocol.master_methods import (
    MASTER_METHODS,
    NO_SPEC,
    Kind,
    Reply,
    method_spec,
    resolve_name,
)

SIGNATURES = {
    # as in rosmaster/master_api.py
    "registerService": ["caller_id", "service", "service_api", "caller_api"],
    "unregisterService": ["caller_id", "service", "service_api"],
    "registerSubscriber": ["caller_id", "topic", "topic_type", "caller_api"],
    "unregisterSubscriber": ["caller_id", "topic", "caller_api"],
    "registerPublisher": ["caller_id", "topic", "topic_type", "caller_api"],
    "unregisterPublisher": ["caller_id", "topic", "caller_api"],
    "subscribeParam": ["caller_id", "caller_api", "key"],
    "unsubscribeParam": ["caller_id", "caller_api", "key"],
    "lookupNode": ["caller_id", "node_name"],
    "lookupService": ["caller_id", "service"],
    "getUri": ["caller_id"],
}
NAMES = {"service", "topic", "key"}


def position(method: str, *names: str) -> int | None:
    parameters = SIGNATURES[method]
    return next((parameters.index(name) for name in names if name in parameters), None)


def test_every_method_with_an_address_has_a_row() -> None:
    assert set(MASTER_METHODS) == set(SIGNATURES)


@pytest.mark.parametrize("method", SIGNATURES)
def test_positions_are_those_of_the_signature(method: str) -> None:
    spec = method_spec(method)
    assert spec.caller_api == position(method, "caller_api")
    assert spec.service_api == position(method, "service_api")
    assert spec.type == position(method, "topic_type")
    if spec.registers or spec.unregisters:
        assert spec.name == position(method, *NAMES)


@pytest.mark.parametrize(
    ("method", "registers", "unregisters", "reply"),
    [
        ("registerService", Kind.SERVICE, None, Reply.OTHER),
        ("unregisterService", None, Kind.SERVICE, Reply.OTHER),
        ("registerSubscriber", Kind.SUBSCRIBER, None, Reply.SLAVE_URIS),
        ("unregisterSubscriber", None, Kind.SUBSCRIBER, Reply.OTHER),
        ("registerPublisher", Kind.PUBLISHER, None, Reply.SLAVE_URIS),
        ("unregisterPublisher", None, Kind.PUBLISHER, Reply.OTHER),
        ("subscribeParam", Kind.PARAM, None, Reply.OTHER),
        ("unsubscribeParam", None, Kind.PARAM, Reply.OTHER),
        ("lookupNode", None, None, Reply.SLAVE_URI),
        ("lookupService", None, None, Reply.SERVICE_URI),
        ("getUri", None, None, Reply.MASTER_URI),
    ],
)
def test_what_a_method_does(
    method: str, registers: Kind | None, unregisters: Kind | None, reply: Reply
) -> None:
    spec = method_spec(method)
    assert (spec.registers, spec.unregisters, spec.reply) == (registers, unregisters, reply)


@pytest.mark.parametrize(
    "method",
    [
        "getParam",
        "setParam",
        "getSystemState",
        "getPublishedTopics",
        "getPid",
        "system.multicall",
        "constructor",
        "__proto__",
        "",
        "registerpublisher",
    ],
)
def test_every_other_method_has_none(method: str) -> None:
    assert method_spec(method) is NO_SPEC


@pytest.mark.parametrize(
    ("name", "caller_id", "resolved"),
    [
        # as rosgraph.names.resolve_name does
        ("/chatter", "/talker", "/chatter"),
        ("/a//b/", "/talker", "/a/b"),
        ("chatter", "/talker", "/chatter"),
        ("chatter", "/ns/talker", "/ns/chatter"),
        ("a/b", "/ns/sub/talker", "/ns/sub/a/b"),
        ("~chatter", "/ns/talker", "/ns/talker/chatter"),
        ("~/chatter", "/talker", "/talker/chatter"),
        ("chatter", "talker", "/chatter"),
        ("chatter", "", "/chatter"),
        ("/", "/talker", "/"),
        ("constructor", "/__proto__/x", "/__proto__/constructor"),
    ],
)
def test_names_are_resolved_as_the_master_does(name: str, caller_id: str, resolved: str) -> None:
    assert resolve_name(name, caller_id) == resolved
