"""The registry refuses names and URIs that are longer than any system's."""

import pytest

from rosproxy.ros1.protocol.name_lengths import (
    LONGEST_NAME,
    too_long_to_ask,
    too_long_to_connect,
    too_long_to_register,
)
from rosproxy.ros1.protocol.xmlrpc.document import parse_call
from rosproxy.shared.uris import (
    LONGEST_URI,
    parse_inside_path,
    parse_service_uri,
    parse_slave_uri,
)
from tests.unit.builders import py_call

REGISTRATIONS = {
    "registerPublisher": ("caller_id", "name", "type", "caller_api"),
    "registerSubscriber": ("caller_id", "name", "type", "caller_api"),
    "registerService": ("caller_id", "name", "service_api", "caller_api"),
    "subscribeParam": ("caller_id", "caller_api", "name"),
}
MOST = {"caller_api": LONGEST_URI, "service_api": LONGEST_URI}
FIELDS = [(method, field) for method, names in REGISTRATIONS.items() for field in names]


@pytest.mark.parametrize(("method", "field"), FIELDS)
def test_what_is_too_long_to_register_is_named_with_its_bound(method: str, field: str) -> None:
    most = MOST.get(field, LONGEST_NAME)

    def said(size: int) -> str | None:
        given = ["x" * size if name == field else "/x" for name in REGISTRATIONS[method]]
        return too_long_to_register(parse_call(py_call(method, *given)))

    assert said(most) is None
    assert said(most + 1) == f"{field} has {most + 1} characters, at most {most} are accepted"


@pytest.mark.parametrize(
    "method", ["setParam", "lookupNode", "unregisterPublisher", "registerPublisher"]
)
def test_what_is_kept_nowhere_passes(method: str) -> None:
    assert too_long_to_register(parse_call(py_call(method, "/n", 5 * LONGEST_NAME))) is None
    if method != "registerPublisher":
        call = parse_call(py_call(method, "/n", "x" * 5 * LONGEST_NAME, "x" * 5 * LONGEST_URI))
        assert too_long_to_register(call) is None


def test_a_call_to_a_node_names_it_and_its_topic_in_short() -> None:
    long = "x" * (LONGEST_NAME + 1)
    for method in ("requestTopic", "publisherUpdate"):
        assert "topic has 1025" in (too_long_to_ask(parse_call(py_call(method, "/n", long))) or "")
        assert too_long_to_ask(parse_call(py_call(method, "/n", "/t", [long]))) is None
    assert "caller_id" in (too_long_to_ask(parse_call(py_call("getPid", long))) or "")
    assert too_long_to_ask(parse_call(py_call("shutdown", "/master", long))) is None


@pytest.mark.parametrize("name", ["callerid", "topic", "service"])
def test_the_names_in_a_connection_header_are_short(name: str) -> None:
    assert too_long_to_connect({name: "x" * LONGEST_NAME, "message_definition": "x" * 9999}) is None
    assert name in (too_long_to_connect({name: "x" * (LONGEST_NAME + 1)}) or "")


def test_what_is_longer_than_a_uri_is_none() -> None:
    for size, fits in ((LONGEST_URI, True), (LONGEST_URI + 1, False)):
        assert bool(parse_slave_uri("http://a:1/".ljust(size, "x"))) == fits
        assert bool(parse_service_uri("rosrpc://a:1/".ljust(size, "x"))) == fits
        assert bool(parse_inside_path("http://a:1/b:2".ljust(size, "/"))) == fits
