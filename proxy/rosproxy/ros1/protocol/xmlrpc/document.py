"""XML-RPC documents, parsed for edits in place.

A parsed document keeps the byte offsets of every value. So an edit replaces the text of single
strings and leaves every other byte unchanged. Decoding and encoding would change types: roscpp
sends untyped strings and ``<i4>``, Python sends ``<string>`` and ``<int>``. XML-RPC also has types
(base64, dateTime) that change on the way through Python.

Specification: http://xmlrpc.com/spec.md.
"""

import re
from collections.abc import Iterable, Sized
from typing import Any
from xml.parsers import expat
from xmlrpc.client import Fault, dumps

import msgspec

from rosproxy.ros1.protocol.xmlrpc import fast, values
from rosproxy.ros1.protocol.xmlrpc.limits import OWN_REPLY, REPLY, Limits
from rosproxy.ros1.protocol.xmlrpc.values import KINDS, SCALARS, Edit, text_of

Value = values.Value
PARSE_ERROR = -32700
"""Fault code: not well formed, or beyond a limit
(http://xmlrpc-epi.sourceforge.net/specs/rfc.fault_codes.php)."""
INVALID_REQUEST = -32600
"""Fault code: well-formed XML that is not an XML-RPC call or response."""
INVALID_PARAMS = -32602
"""Fault code: the parameters do not fit the method."""
SYSTEM_ERROR = -32400
"""Fault code: an error in the proxy itself."""

LONGEST_TAG = 4096
"""The highest number of bytes of a tag. Tags of ROS have no attributes, and 20 bytes at most."""
# The value of an attribute may contain ``>``, but never ``<``. The quantifiers are possessive: a
# plain quantifier keeps a state of 100 bytes for each byte of a long tag.
_TAG = re.compile(rb"<(?:[^<>\"']++|\"[^<\"]*+\"|'[^<']*+')*+>")
_LONG_TAG = re.compile(rb"(?=<[^!?][^<]{%d})%b" % (LONGEST_TAG - 1, _TAG.pattern))
"""A tag that is longer than LONGEST_TAG together with the text up to the next tag."""
_ENCODINGS = frozenset({"utf-8", "us-ascii", "ascii", "iso-8859-1"})
_NEVER_PREFIXED = frozenset(
    {"methodName", "params", "fault", "value", "string", "array", "struct", "member", "name"}
)
"""Elements that must not have a prefix, because Python's Unmarshaller ignores the prefix, as in
``<x:value>``."""


class XmlRpcError(ValueError):
    """A document that the proxy refuses.

    ``code`` is the XML-RPC fault code of the answer; the message says what is wrong.
    """

    def __init__(self, code: int, message: str) -> None:
        super().__init__(message)
        self.code = code


class Call(msgspec.Struct, frozen=True):
    """A method call: the method's name and its parameters."""

    method: str
    params: list[Value]

    def string_value(self, index: int | None) -> Value | None:
        """Parameter ``index`` if it exists and is a string, else None."""
        if index is None or index >= len(self.params):
            return None
        return self.params[index] if self.params[index].kind == "string" else None

    def string(self, index: int | None) -> str | None:
        """The text of parameter ``index`` if it exists and is a string, else None."""
        value = self.string_value(index)
        return value.text if value else None


def apply(body: bytes, edits: Iterable[Edit]) -> bytes:
    """Apply edits to a document, in any order. Edits must not overlap.

    Several insertions at the same place keep their order.
    """
    pieces = []
    position = 0
    for edit in sorted(edits, key=lambda edit: (edit.start, edit.end)):
        pieces += [body[position : edit.start], edit.text]
        position = edit.end
    return b"".join([*pieces, body[position:]])


def parse_call(body: bytes, limits: Limits = OWN_REPLY) -> Call:
    """Parse a ``methodCall``.

    Raises XmlRpcError if the document is malformed, contains a DTD or entities, is too large or
    deep, or is not a method call. With several method names, XmlRpc++ takes the first, even in a
    comment, and Python takes the last element. So such a document is refused as well.
    """
    plain = fast.call(body, limits)
    if plain is not None:
        return Call(*plain)
    parser = _Parser(body, limits)
    if parser.root != "methodCall" or not parser.method:
        text = "the document is not an XML-RPC call: a methodCall with a methodName is missing"
        raise XmlRpcError(INVALID_REQUEST, text)
    if body.count(b"<methodName") != 1:
        raise XmlRpcError(INVALID_REQUEST, "the call has more than one methodName")
    return Call(parser.method, parser.values)


def parse_reply(body: bytes, limits: Limits = REPLY) -> Value | None:
    """Parse a ``methodResponse``; None if it is a fault.

    Raises XmlRpcError if the document is malformed, too large or deep, or is not a response.
    """
    value, fault = parse_response(body, limits)
    return None if fault else value


def parse_response(body: bytes, limits: Limits = OWN_REPLY) -> tuple[Value, bool]:
    """Parse a ``methodResponse``: its value, and whether the value is a fault.

    Raises XmlRpcError as ``parse_reply`` does.
    """
    plain = fast.response(body, limits)
    if plain is not None:
        return plain, False
    parser = _Parser(body, limits)
    if parser.root != "methodResponse" or len(parser.values) != 1:
        raise XmlRpcError(INVALID_REQUEST, "the document is not an XML-RPC response")
    return parser.values[0], parser.fault


def read_response(body: bytes, limits: Limits = OWN_REPLY) -> Any:
    """The value of a reply from the master or a node, or of a fault. Raises XmlRpcError."""
    plain = fast.lists(body, limits)
    return python_value(parse_response(body, limits)[0]) if plain is None else plain


def dump_call(method: str, *params: Any) -> bytes:
    """A ``methodCall`` of the proxy itself."""
    return dumps(params, method).encode()


def dump_reply(value: Any) -> bytes:
    """A ``methodResponse`` of the proxy itself."""
    return dumps((value,), methodresponse=True).encode()


def dump_fault(code: int, message: str) -> bytes:
    """A fault response of the proxy itself."""
    return dumps(Fault(code, message), methodresponse=True).encode()


def dump_value(value: Any) -> bytes:
    """The ``<value>`` element of a Python value."""
    text = dumps((value,)).encode()
    return text[text.index(b"<value>") : text.rindex(b"</value>") + len(b"</value>")]


def python_value(value: Value) -> Any:
    """Convert a value to Python, for lists of strings and numbers such as ROS status triples.

    Kinds other than string, int, array and struct become their text. An int that is no number
    becomes None.
    """
    if value.kind == "array":
        return [python_value(item) for item in value.items]
    if value.kind == "struct":
        return dict(zip(value.members, map(python_value, value.items), strict=True))
    return value.integer() if value.kind == "int" else value.text


def exceeds_elements(body: bytes, limits: Limits) -> bool:
    """Whether a document has too many elements to read."""
    shortest = len("<a/>")
    if len(body) <= shortest * limits.elements:
        return False
    return body.count(b"</") + body.count(b"/>") > limits.elements


def _has_long_tag(body: bytes) -> bool:
    return any(tag.end() - tag.start() > LONGEST_TAG for tag in _LONG_TAG.finditer(body))


class _Parser:
    """A pass of expat over a document that collects values with byte offsets."""

    def __init__(self, body: bytes, limits: Limits) -> None:
        self.body = body
        self._limits = limits
        self.root = ""
        self.method = ""
        self.fault = False
        self.values: list[Value] = []
        self._encoding = "utf-8"
        self._path: list[str] = []
        self._open: list[Value] = []
        self._count = 0
        self._name_start = 0
        if len(body) > limits.size:
            raise XmlRpcError(PARSE_ERROR, f"the document is longer than {limits.size} bytes")
        if exceeds_elements(body, limits):  # before any element takes memory
            text = f"the document has more than {limits.elements} elements"
            raise XmlRpcError(PARSE_ERROR, text)
        # When expat reports a tag, all its attributes are in memory, each in some 200 bytes.
        if _has_long_tag(body):
            text = f"the document has a tag of more than {LONGEST_TAG} bytes"
            raise XmlRpcError(PARSE_ERROR, text)
        # expat recognizes UTF-16 by itself, but this module looks for tags and texts in ASCII.
        if b"\0" in body:
            raise XmlRpcError(PARSE_ERROR, "the document has NUL bytes; use UTF-8")
        self._expat = parser = expat.ParserCreate()
        parser.StartElementHandler = self._start
        parser.EndElementHandler = self._end
        parser.StartDoctypeDeclHandler = self._doctype
        parser.XmlDeclHandler = self._declaration
        try:
            parser.Parse(body, True)
        except expat.ExpatError as error:
            raise XmlRpcError(
                PARSE_ERROR, f"the document is not well-formed XML: {error}"
            ) from None

    def _doctype(self, *_: object) -> None:
        raise XmlRpcError(PARSE_ERROR, "document type declarations are refused")

    def _declaration(self, version: str, encoding: str | None, standalone: int) -> None:
        self._encoding = (encoding or self._encoding).lower()
        if self._encoding not in _ENCODINGS:
            name = self._encoding[:20]
            text = f"the encoding {name} of the document is not supported; use UTF-8"
            raise XmlRpcError(PARSE_ERROR, text)

    def _start(self, name: str, attributes: Sized) -> None:
        self._path.append(name)
        self._count += 1 + len(attributes)
        self.root = self.root or name
        self._check(name)
        if name == "value":
            self._start_value()
        elif name in KINDS:
            self._start_kind(name)
        elif name in ("methodName", "name"):
            self._name_start = self._tag_end()
        elif name == "fault":
            self.fault = True
        elif self._path[-2:-1] == ["value"]:
            self._open[-1].kind = "other"  # an extension type, such as ``ex:nil``: passes unchanged

    def _check(self, name: str) -> None:
        """Refuse an element that exceeds a limit or that readers could understand in two ways."""
        if len(self._path) > self._limits.depth:
            text = f"the document is nested deeper than {self._limits.depth} elements"
            raise XmlRpcError(PARSE_ERROR, text)
        if self._count > self._limits.elements:
            text = f"the document has more than {self._limits.elements} elements and attributes"
            raise XmlRpcError(PARSE_ERROR, text)
        if ":" in name and name.rpartition(":")[2] in _NEVER_PREFIXED:
            raise XmlRpcError(
                INVALID_REQUEST, "an XML-RPC element must not have a namespace prefix"
            )

    def _end(self, name: str) -> None:
        self._path.pop()
        if name == "value":
            self._end_value()
        elif name in SCALARS:
            value = self._open[-1]
            value.inner = (value.inner[0], max(value.inner[0], self._expat.CurrentByteIndex))
        elif name == "methodName":
            self.method = self._text().strip()
        elif name == "name" and self._open and self._path[-1:] == ["member"]:
            self._open[-1].members.append(self._text())

    def _start_value(self) -> None:
        inside = self._tag_end()
        outer = self._expat.CurrentByteIndex, inside
        self._open.append(Value(self.body, self._encoding, outer=outer, inner=(inside, -1)))

    def _start_kind(self, name: str) -> None:
        if not self._open or self._path[-2:-1] != ["value"]:
            raise XmlRpcError(INVALID_REQUEST, f"the element <{name}> is not inside a <value>")
        value = self._open[-1]
        value.kind = KINDS[name]
        if name in SCALARS:
            value.inner = (self._tag_end(), -1)

    def _end_value(self) -> None:
        value = self._open.pop()
        index = self._expat.CurrentByteIndex
        if value.inner[1] < 0:
            value.inner = (value.inner[0], max(value.inner[0], index))
        # At the end of ``<value/>`` expat is already at the start of the next tag.
        if self.body[value.outer[1] - 2 : value.outer[1]] != b"/>":
            value.outer = (value.outer[0], self._tag_end())
        if value.kind == "struct" and len(value.members) != len(value.items):
            raise XmlRpcError(INVALID_REQUEST, "a struct member needs one name and one value")
        (self._open[-1].items if self._open else self.values).append(value)

    def _text(self) -> str:
        """The text of the name element that ends here."""
        raw = self.body[self._name_start : max(self._name_start, self._expat.CurrentByteIndex)]
        return text_of(raw, self._encoding)

    def _tag_end(self) -> int:
        return next(_TAG.finditer(self.body, self._expat.CurrentByteIndex)).end()
