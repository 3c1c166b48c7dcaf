"""XML-RPC documents that the proxy composes from foreign and own parts."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.protocol.xmlrpc import multicall
from rosproxy.ros1.protocol.xmlrpc.document import XmlRpcError
from tests.unit.builders import DIALECTS, decoded, py_reply, python_values, raw_call

PARAMS = ["/n", "", "a<&>'\"é", 5, True, 1.5, [[], [1, "x"]], {"a": {"b": "c"}}]


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_call_of_a_multicall_stands_alone(dialect: str) -> None:
    call, _ = DIALECTS[dialect]
    elements = [{"methodName": "a", "params": PARAMS}, {"methodName": "b&<c>é", "params": []}]
    first, second = multicall.inner_calls(xmlrpc.parse_call(call("system.multicall", elements)))
    assert first
    assert second
    assert decoded(multicall.single_call(first)) == (tuple(PARAMS), "a")
    assert decoded(multicall.single_call(second)) == ((), "b&<c>é")


def test_a_part_of_a_latin1_document_is_taken_out_in_utf8() -> None:
    """A document without a declared encoding is UTF-8, so Latin-1 bytes would be unreadable."""
    call = xmlrpc.parse_call(raw_call("<value>é</value>", encoding="iso-8859-1"))
    assert decoded(multicall.single_call(call)) == (("é",), "m")
    reply = (
        b"<?xml version='1.0' encoding='iso-8859-1'?><methodResponse><params><param>"
        b"<value>\xe9</value></param></params></methodResponse>"
    )
    assert python_values(multicall.results_reply([multicall.result_value(reply)])) == [[["é"]]]


@pytest.mark.parametrize("dialect", DIALECTS)
def test_replies_are_put_together_as_a_multicall_returns_them(dialect: str) -> None:
    _, reply = DIALECTS[dialect]
    results = [
        multicall.result_value(reply([1, "", PARAMS])),
        multicall.result_value(xmlrpc.dump_fault(4, "too <much>")),
        multicall.fault_value(-1, "no call"),
        multicall.result_value(reply("")),
    ]
    assert python_values(multicall.results_reply(results)) == [
        [
            [[1, "", PARAMS]],
            {"faultCode": 4, "faultString": "too <much>"},
            {"faultCode": -1, "faultString": "no call"},
            [""],
        ]
    ]
    assert python_values(multicall.results_reply([])) == [[]]


@pytest.mark.parametrize("reply", [b"", b"<html/>", b"<methodResponse/>", raw_call("<value/>")])
def test_what_is_no_reply_is_no_result(reply: bytes) -> None:
    with pytest.raises(XmlRpcError):
        multicall.result_value(reply)


@given(st.lists(st.sampled_from("abc"), min_size=1), st.data())
def test_values_are_inserted_at_their_places(kept: list[str], data: st.DataObject) -> None:
    count = data.draw(st.integers(0, 4))
    places = st.integers(0, len(kept) + count - 1)
    indices = sorted(data.draw(st.lists(places, min_size=count, max_size=count, unique=True)))
    value = xmlrpc.parse_reply(py_reply(kept))
    assert value
    inserts = [(index, xmlrpc.dump_value({"new": index})) for index in indices]
    body = xmlrpc.apply(value.body, multicall.insert_items(value, inserts))
    expected: list[object] = list(kept)
    for index in indices:
        expected.insert(index, {"new": index})
    assert python_values(body) == [expected]


def test_own_documents_are_what_python_reads() -> None:
    assert decoded(xmlrpc.dump_call("m", "a<b", 5, [1])) == (("a<b", 5, [1]), "m")
    assert decoded(xmlrpc.dump_reply([1, "é", {}])) == (([1, "é", {}],), None)
    fault = xmlrpc.dump_fault(-32600, "no <call>")
    assert xmlrpc.parse_reply(fault) is None
    assert b"no &lt;call&gt;" in fault
