"""``system.multicall``: many calls in a single call, ``[{methodName: string, params: array}, …]``.

The result of a success is an array with a single element, the result of a failure a fault struct
(https://mirrors.talideon.com/articles/multicall.html).
"""

from collections.abc import Iterable, Sequence
from xml.sax.saxutils import escape

from rosproxy.ros1.protocol.xmlrpc.document import (
    INVALID_PARAMS,
    Call,
    Value,
    XmlRpcError,
    dump_value,
    parse_response,
)
from rosproxy.ros1.protocol.xmlrpc.limits import REPLY
from rosproxy.ros1.protocol.xmlrpc.values import Edit

MULTICALL = "system.multicall"
MOST_CALLS = 1000
"""The highest number of calls in a multicall. The proxy admits these calls in order, or sends the
calls to a node in order. Only roslaunch and the proxy itself (a hundred at once) send multicalls.
The multicalls of roslaunch set parameters; above 64 KiB their calls are not counted (`passing`)."""


def inner_items(call: Call) -> list[Value]:
    """The elements of a multicall's parameter; empty if the parameter is not a single array."""
    if len(call.params) != 1 or call.params[0].kind != "array":
        return []
    return call.params[0].items


def inner_calls(call: Call) -> list[Call | None]:
    """The calls of a multicall, in order; None for an element that is no call.

    Raises XmlRpcError for too many calls, for a call with a repeated member, and for a multicall
    inside the multicall. rosmaster would execute the inner multicall, and XmlRpc++ would recurse
    without end.
    """
    items = inner_items(call)
    if len(items) > MOST_CALLS:
        raise XmlRpcError(
            INVALID_PARAMS,
            f"{MULTICALL} has {len(items)} calls, at most {MOST_CALLS} are accepted",
        )
    return [_inner_call(item) for item in items]


def single_call(call: Call) -> bytes:
    """A call of a multicall as a separate document, with the parameters as sent."""
    params = b"".join(b"<param>%b</param>" % value.raw for value in call.params)
    head = b"<methodName>%b</methodName>" % escape(call.method).encode()
    return b"<?xml version='1.0'?><methodCall>%b<params>%b</params></methodCall>" % (head, params)


def result_value(reply: bytes) -> bytes:
    """The reply to a single call, as a result of a multicall.

    Raises XmlRpcError if the reply is no XML-RPC response.
    """
    value, fault = parse_response(reply, REPLY)
    return value.raw if fault else _array([value.raw])


def fault_value(code: int, message: str) -> bytes:
    """A fault of the proxy itself, as a result of a multicall."""
    return dump_value({"faultCode": code, "faultString": message})


def results_reply(results: Iterable[bytes]) -> bytes:
    """The ``methodResponse`` of a multicall with these results, which are raw values."""
    params = b"<params><param>%b</param></params>" % _array(results)
    return b"<?xml version='1.0'?><methodResponse>%b</methodResponse>" % params


def insert_items(array: Value, inserts: Sequence[tuple[int, bytes]]) -> list[Edit]:
    """Edits that insert raw values into an array of at least one item.

    Each insert is (index in the finished array, value), with rising indices.
    """
    edits = []
    items = array.items
    for done, (index, raw) in enumerate(inserts):
        successor = index - done
        offset = items[successor].outer[0] if successor < len(items) else items[-1].outer[1]
        edits.append(Edit(offset, offset, raw))
    return edits


def _inner_call(item: Value) -> Call | None:
    if len(set(item.members)) < len(item.members):  # Python takes the last member of a name
        raise XmlRpcError(INVALID_PARAMS, f"a call in {MULTICALL} has a member twice")
    method = item.member("methodName")
    params = item.member("params")
    name = method.string() if method else None
    if name == MULTICALL:
        raise XmlRpcError(INVALID_PARAMS, f"{MULTICALL} must not contain {MULTICALL}")
    if not name or params is None or params.kind != "array":
        return None
    return Call(name, params.items)


def _array(items: Iterable[bytes]) -> bytes:
    return b"<value><array><data>" + b"".join(items) + b"</data></array></value>"
