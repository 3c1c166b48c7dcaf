"""XML-RPC documents in the plain form of ROS's clients, read by regular expressions.

A plain document has only printable ASCII and tags without attributes, but no entities, comments,
CDATA or self-closing tags. So a tag ends at the next ``>``, a text at the next ``<``, and all
readers find the same content. expat reads all other documents, four times as slowly, and decides
what is an error. In the replies that `lists` reads, texts may also have entities and any letters.
"""

import re
from collections.abc import Callable, Iterator
from typing import Any
from xml.sax.saxutils import unescape

from rosproxy.ros1.protocol.xmlrpc.limits import OWN_REPLY, Limits
from rosproxy.ros1.protocol.xmlrpc.values import KINDS, Value, text_of

_PLAIN = bytes({*b"\t\n\r", *range(0x20, 0x7F)} - {*b"&"})
_IN_LISTS = bytes({*b"\t\n\r", *range(0x20, 0x100)})
_OTHER_ENTITY = re.compile(rb"&(?!(?:amp|lt|gt|quot|apos);)")
_FORBIDDEN = b"]]>", b"\xef\xbf\xbe", b"\xef\xbf\xbf"
"""What may be in no text (XML 1.0, 2.2 and 2.4)."""
_QUOTES = {"&quot;": '"', "&apos;": "'"}
_PROLOG = rb"(?:<\?xml version=(?:'1\.0'|\"1\.0\")\?>)?\s*"
_CALL = re.compile(_PROLOG + rb"<methodCall>\s*<methodName>\s*([^<\s]+)\s*</methodName>\s*<params>")
_CALL_END = re.compile(rb"\s*</params>\s*</methodCall>\s*\Z")
_RESPONSE = re.compile(_PROLOG + rb"<methodResponse>\s*<params>")
_RESPONSE_END = re.compile(rb"\s*</params>\s*</methodResponse>\s*\Z")
_TEXT_OF_SCALAR = rb"[\t\n\r\x20-\x25\x27-\x3b=?-\x7e]*+"
"""Plain text without ``>``, so that no ``]]>`` is in it."""
_SCALAR = rb"<value>(?:\s*(?:%b)\s*|%b)</value>" % (
    b"|".join(
        b"<%b>%b</%b>" % (kind, _TEXT_OF_SCALAR, kind)
        for kind in (b"string", b"int", b"i4", b"i8", b"boolean", b"double")
    ),
    _TEXT_OF_SCALAR,
)
_SCALARS_CALL = re.compile(
    _PROLOG
    + rb"<methodCall>\s*<methodName>\s*([\w./]+)\s*</methodName>\s*<params>"
    + rb"(?:\s*<param>\s*%b\s*</param>)*+" % _SCALAR
    + _CALL_END.pattern
)
_LIST_OF = rb"<value>\s*<array>\s*<data>(?:\s*%b)*+\s*</data>\s*</array>\s*</value>"
_METHOD = rb"<name>methodName</name>\s*<value>\s*(?:<string>[\w./]+</string>|[\w./]+)\s*</value>"
_INNER_CALL = (
    rb"\s*<value>\s*<struct>\s*<member>\s*%b\s*</member>\s*<member>\s*<name>params</name>\s*%b\s*"
    rb"</member>\s*</struct>\s*</value>"
) % (_METHOD, _LIST_OF % (rb"(?:%b|%b)" % (_SCALAR, _LIST_OF % _SCALAR)))
_MULTICALL = re.compile(
    _PROLOG
    + rb"<methodCall>\s*<methodName>\s*system\.multicall\s*</methodName>\s*<params>\s*<param>\s*"
    + rb"<value>\s*<array>\s*<data>(?:%b)*+\s*</data>\s*</array>\s*</value>\s*</param>"
    % _INNER_CALL
    + _CALL_END.pattern
)
_INNER_METHOD = re.compile(rb"<name>methodName</name>\s*<value>\s*(?:<string>)?([\w./]+)")
# The last group is empty, so that there is always a match: `finditer` would skip other text.
_TOKEN = re.compile(
    rb"""\s*(?:
    (<value>)(?:
        \s*<(string|int|i4|i8|boolean|double|dateTime\.iso8601|base64)>([^<]*)</\2>\s*</value>
        |([^<]*)</value>
        |\s*<array>\s*<data>()
        |\s*<struct>()
    )
    |</data>\s*</array>\s*</value>()
    |<member>\s*<name>([^<]*)</name>
    |</member>()
    |</struct>\s*</value>()
    |<param>()
    |</param>()
    |()
    )""",
    re.VERBOSE,
)
_LIST_TOKEN = re.compile(
    rb"""\s*(?:
    <value>\s*<(?:
        string>([^<]*)</string>\s*</value>
        |(?:int|i4)>(-?\d{1,18})</(?:int|i4)>\s*</value>
        |array>\s*<data>()
    )
    |</data>\s*</array>\s*</value>()
    )""",
    re.VERBOSE,
)
_STRING, _INTEGER, _LIST, _LIST_END = range(1, 5)
_FIRST_PARAM = re.compile(rb"\s*<param>")
_LAST_PARAM = re.compile(rb"\s*</param>" + _RESPONSE_END.pattern)
_OUTER_ELEMENTS = "methodResponse", "params", "param", "value", "string"
"""The elements around a text outside of lists. Each list adds three."""
_VALUE, _TYPE, _TYPED, _TEXT, _ARRAY, _STRUCT = range(1, 7)
_ARRAY_END, _NAME, _MEMBER_END, _STRUCT_END, _PARAM, _PARAM_END, _NONE = range(7, 14)
"""The groups of a token. The last group of a match tells the kind of the token."""
_VALUE_END_LENGTH = len(b"</value>")
_KINDS = {name.encode(): kind for name, kind in KINDS.items()}

_Tokens = Iterator[re.Match[bytes]]


class _NotPlain(Exception):
    """A document that does not have the plain form."""


def call(body: bytes, limits: Limits = OWN_REPLY) -> tuple[str, list[Value]] | None:
    """The method and parameters of a ``methodCall``.

    None without the plain form, or beyond ``limits``.
    """
    head = _CALL.match(body)
    if head is None or not _is_plain(body, limits):
        return None
    params = _params(body, head.end(), _CALL_END, limits.depth)
    return None if params is None else (head[1].decode(), params)


def method_of_scalars(body: bytes) -> str | None:
    """The method of a plain call with only texts and numbers as parameters, else None."""
    match = _SCALARS_CALL.match(body)
    return match[1].decode() if match else None


def methods_of_multicall(body: bytes) -> set[str] | None:
    """The methods in a plain multicall with only scalars and lists of scalars as parameters.

    None for any other document.
    """
    if not _MULTICALL.match(body):
        return None
    return {method.decode() for method in _INNER_METHOD.findall(body)}


def response(body: bytes, limits: Limits = OWN_REPLY) -> Value | None:
    """The value of a ``methodResponse``.

    None for a fault, without the plain form, or beyond ``limits``.
    """
    head = _RESPONSE.match(body)
    if head is None or not _is_plain(body, limits):
        return None
    params = _params(body, head.end(), _RESPONSE_END, limits.depth)
    return params[0] if params is not None and len(params) == 1 else None


def lists(body: bytes, limits: Limits = OWN_REPLY) -> list[Any] | None:
    """The value of a ``methodResponse`` that is a list of strings, numbers and lists; else None.

    The master sends such replies, and replies with all topics are long. The function takes a fifth
    of the time of `response`, which also finds the position of each value. Texts may have any
    characters: a single name would make the reading of all others several times as slow.
    """
    head = _RESPONSE.match(body)
    param = _FIRST_PARAM.match(body, head.end()) if head else None
    if param is None or not _fits_lists(body, limits):
        return None
    text_of_token = _text if body.translate(None, _PLAIN) or b"\r" in body else bytes.decode
    depth = (limits.depth - len(_OUTER_ELEMENTS)) // 3
    top = list[Any]()
    try:
        end = _read_lists(body, param.end(), top, depth, text_of_token)
    except UnicodeDecodeError:
        return None
    value = top[0] if end is not None and _LAST_PARAM.match(body, end) else None
    return value if isinstance(value, list) else None


def _read_lists(
    body: bytes, start: int, top: list[Any], depth: int, text_of_token: Callable[[bytes], str]
) -> int | None:
    """Read a value into ``top``; return the position after the value.

    None if the value has another form, or more than ``depth`` nested lists. Raises
    UnicodeDecodeError.
    """
    # `scanner` is not documented. Each match has to begin where the last match has ended.
    stack = [top]
    match = _LIST_TOKEN.scanner(body, start).match  # type: ignore[attr-defined]
    while (token := match()) and len(stack) <= depth:
        group = token.lastindex
        if group == _STRING:
            stack[-1].append(text_of_token(token[_STRING]))
        elif group == _INTEGER:
            stack[-1].append(int(token[_INTEGER]))
        elif group == _LIST:
            stack[-1].append([])
            stack.append(stack[-1][-1])
        else:
            stack.pop()
        if len(stack) < 2:
            return int(token.end())
    return None


def _text(raw: bytes) -> str:
    """The text of a string, with entities and line ends resolved (XML 1.0, 2.11)."""
    text = raw.decode()
    if b"\r" in raw:
        text = text.replace("\r\n", "\n").replace("\r", "\n")
    return unescape(text, _QUOTES) if b"&" in raw else text


def _fits_lists(body: bytes, limits: Limits) -> bool:
    return (
        len(body) <= limits.size
        and not body.translate(None, _IN_LISTS)
        and not any(part in body for part in _FORBIDDEN)
        and not _OTHER_ENTITY.search(body)
        and body.count(b"</") <= limits.elements
    )


def _is_plain(body: bytes, limits: Limits) -> bool:
    return (
        len(body) <= limits.size
        and not body.translate(None, _PLAIN)
        and b"]]>" not in body  # forbidden in texts (XML 1.0, 2.4)
        and body.count(b"</") <= limits.elements  # each element has a closing tag
    )


def _params(body: bytes, start: int, end: re.Pattern[bytes], depth: int) -> list[Value] | None:
    tokens = _TOKEN.finditer(body, start)
    params = list[Value]()
    position = start
    try:
        for token in tokens:
            if token.lastindex != _PARAM:
                break
            params.append(_value(body, next(tokens), tokens, depth - 3))
            last = next(tokens)
            if last.lastindex != _PARAM_END:
                return None
            position = last.end()
    except (_NotPlain, StopIteration):
        return None
    return params if end.match(body, position) else None


def _value(body: bytes, token: re.Match[bytes], tokens: _Tokens, depth: int) -> Value:
    """The value that a token begins. Raises _NotPlain.

    ``depth``: how many levels of elements may follow here. The value itself is the first level.
    """
    group = token.lastindex
    start, inside = token.span(_VALUE)
    if group == _TYPED and depth > 1:
        kind = _KINDS[token[_TYPE]]
        return Value(body, "utf-8", kind, (start, token.end()), token.span(_TYPED), [], [])
    if group == _TEXT and depth:
        return Value(body, "utf-8", "string", (start, token.end()), token.span(_TEXT), [], [])
    if depth < 4:  # an item would be too deep; expat finds out whether there is an item
        raise _NotPlain
    items = list[Value]()
    members = list[str]()
    if group == _ARRAY:
        kind = "array"
        end = _array(body, tokens, depth - 3, items)
    elif group == _STRUCT:
        kind = "struct"
        end = _struct(body, tokens, depth - 3, items, members)
    else:
        raise _NotPlain
    inner = inside, end - _VALUE_END_LENGTH
    return Value(body, "utf-8", kind, (start, end), inner, items, members)


def _array(body: bytes, tokens: _Tokens, depth: int, items: list[Value]) -> int:
    """Read items up to the end of the array; return the position after the array."""
    for token in tokens:
        if token.lastindex == _ARRAY_END:
            return token.end()
        items.append(_value(body, token, tokens, depth))
    raise _NotPlain


def _struct(
    body: bytes, tokens: _Tokens, depth: int, items: list[Value], members: list[str]
) -> int:
    """Read members up to the end of the struct; return the position after the struct."""
    for token in tokens:
        if token.lastindex == _STRUCT_END:
            return token.end()
        if token.lastindex != _NAME:
            break
        members.append(text_of(token[_NAME], "utf-8"))
        items.append(_value(body, next(tokens), tokens, depth))
        if next(tokens).lastindex != _MEMBER_END:
            break
    raise _NotPlain
