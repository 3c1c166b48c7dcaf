"""Calls that pass unread, because they are large and hold no address: parameters, above all.

The method is read from the head of the document, in the form that ROS's clients write; a document
with another head is read whole, within the bounds of `limits`. The rest is only watched while it
passes: the master, or a node, must not see another method than was judged. Whoever takes the pieces
further holds the last one back until all were watched, so that nobody acts on a refused document:
rosmaster and nodes read a body to its end before they look into it.

A ``system.multicall``, by which roslaunch sets parameters, is taken apart by expat, piece by piece:
it passes if each of its calls does. Its grammar is held to the letter, as Python's Unmarshaller
(xmlrpc/client.py), which keeps a stack and knows no grammar, could see another one. A regular
expression has seen the usual document in a twentieth of that time (`fast.methods_of_multicall`).
"""

import re
from collections.abc import Callable, Collection, Iterable, Iterator
from xml.parsers import expat

from rosproxy.ros1.protocol.xmlrpc import fast
from rosproxy.ros1.protocol.xmlrpc.document import (
    INVALID_REQUEST,
    PARSE_ERROR,
    XmlRpcError,
)
from rosproxy.ros1.protocol.xmlrpc.multicall import MULTICALL
from rosproxy.ros1.protocol.xmlrpc.values import text_of

SHORT = 64 * 1024
"""Bytes up to which a document is read whole, whatever it is: that takes some milliseconds."""
HEAD = 4096
"""Bytes of a document in which its method is looked for."""
DEPTH = 64
"""Elements of a multicall inside of each other, as `Limits` has it for what is read."""
LONGEST_MARKUP = 64 * 1024
"""Bytes of a tag, comment or processing instruction of a multicall. expat keeps one until it is
whole. Before version 2.6 expat reads it again from its start with each piece that comes."""
LONGEST_NAMES = 4096
"""Characters of the names of all elements and attributes of a multicall, each counted once. The
parser keeps them until the end of the document. XML-RPC has 20 names."""

_HEAD = re.compile(
    rb"""(?:<\?xml\s+version=(?:'1\.0'|"1\.0")
    (?:\s+encoding=(["'])(?i:utf-8|us-ascii|ascii|iso-8859-1)\1)?\s*\?>)?
    \s*<methodCall>\s*<methodName>([\w./]{1,200})</methodName>""",
    re.VERBOSE,
)
_STATUS = re.compile(
    rb"""(?:<\?xml\s+version=(?:'1\.0'|"1\.0")[^>]{0,100}\?>)?
    \s*<methodResponse>\s*<params>\s*<param>\s*<value>\s*<array>\s*<data>
    \s*<value>\s*<(int|i4)>\s*(-?\d{1,9})\s*</\1>\s*</value>""",
    re.VERBOSE,
)
_PARAMS_BEGIN = re.compile(rb"\s*<params>\s*")
# Without markup, references and bytes beyond ASCII a text is the same in each encoding of _HEAD and
# to every parser.
_STRING_PARAM = re.compile(
    rb"\s*<param>\s*<value>(?:\s*<string>([^<&\x80-\xff]*)</string>\s*|([^<&\x80-\xff]*))"
    rb"</value>\s*</param>\s*"
)
# With a prefix, too: Python's Unmarshaller drops it (xmlrpc/client.py, end). NUL bytes are those of
# UTF-16, which expat recognizes by itself, and in which a search for bytes finds no name.
_FORBIDDEN = re.compile(rb"[<:]methodName[\s/>]|<!DOCTYPE|<!ENTITY|\0")
_HINTS = (b"methodName", b"<!DOCTYPE", b"<!ENTITY", b"\0")
"""One of them is in all that is forbidden; to look for them first takes a hundredth of the time."""
_NESTING = re.compile(rb"<(/?)(?:array|struct)>")
_LONGEST = len(b"<methodName>")
"""Bytes of the longest thing that is looked for."""
NESTED = 20
"""Arrays and structs inside of each other: XmlRpc++ takes a piece of its stack for each."""

_LEVELS = (
    {"methodCall"},
    {"methodName", "params"},
    *({name} for name in ("param", "value", "array", "data", "value", "struct", "member")),
    {"name", "value"},
    {"string", "array"},
)
"""The elements of a multicall, from the root down to what a call's members hold."""
_VALUE_DEPTH = 7
"""The depth of a value that holds a call."""
_CALL_DEPTH = 8
"""The depth of a call's struct."""
_MEMBER_DEPTH = 9
"""The depth of a call's members."""
_FIELD_DEPTH = 10
"""The depth of a member's name and value."""
_CONTENT_DEPTH = 11
"""The depth of what a member's value holds."""
_METHOD = ["name:methodName", "value"]
_PARAMS = ["name:params", "value", "array"]


def method_of(head: bytes) -> str | None:
    """The method of a call whose document begins so; None if that can't be told from its head."""
    match = _HEAD.match(head, 0, HEAD)
    return match[2].decode() if match else None


def first_strings(head: bytes, count: int) -> list[str | None]:
    """The first ``count`` parameters of a call whose document begins so, if they are strings.

    None stands for the first one that can't be told for sure, and for all that follow.
    """
    match = _HEAD.match(head, 0, HEAD)
    position = match.end() if match else 0
    strings = list[str | None]()
    opening = _PARAMS_BEGIN.match(head, position) if match else None
    position = opening.end() if opening else 0
    for _ in range(count if opening else 0):
        param = _STRING_PARAM.match(head, position)
        if param is None:
            break
        strings.append(text_of(param[1] if param[1] is not None else param[2], "utf-8"))
        position = param.end()
    return [*strings, *[None] * (count - len(strings))]


def status_of(head: bytes) -> int | None:
    """The ROS status of a reply that begins so; None if that can't be told from its head."""
    match = _STATUS.match(head, 0, HEAD)
    return int(match[2]) if match else None


class CallWatch:
    """Watches a document that passes, from its head on."""

    def __init__(self) -> None:
        self._tail: bytes | None = None
        self._nested = 0

    def see(self, piece: bytes) -> None:
        """Look at the next piece; the first one holds the method. Raises XmlRpcError."""
        if self._tail is None:
            head = _HEAD.match(piece)
            piece = piece[head.end() :] if head else piece
        text = (self._tail or b"") + piece
        match = _FORBIDDEN.search(text) if any(hint in text for hint in _HINTS) else None
        if match:
            token = match[0].decode("latin-1").strip("\0<:/> \t\r\n") or "a NUL byte"
            raise XmlRpcError(INVALID_REQUEST, f"{token} is not allowed inside a long call")
        for tag in _NESTING.finditer(text):
            if tag.end() <= len(self._tail or b""):  # seen with the piece before
                continue
            # Tags count wherever they stand, also in a comment or CDATA. Those that close nothing
            # must not make room for more.
            self._nested = max(self._nested - 1, 0) if tag[1] else self._nested + 1
            if self._nested > NESTED:
                raise XmlRpcError(
                    PARSE_ERROR, f"arrays and structs are nested deeper than {NESTED} levels"
                )
        # What is looked for may begin here and end in the next piece.
        self._tail = text[1 - _LONGEST :]

    def end(self) -> None:
        """All of it was seen. Raises XmlRpcError if it should not have ended."""

    def passes(self, _body: bytes) -> bool:
        """Whether a whole document passes at a glance; it is watched otherwise."""
        return False


class MulticallWatch(CallWatch):
    """Watches a multicall that passes; ``may_pass`` says whether calls of a method pass unread."""

    def __init__(self, may_pass: Callable[[str], bool]) -> None:
        super().__init__()
        self._may_pass = may_pass
        self._depth = 0
        self._has_call = False
        self._text = ""
        self._elements: list[str] = []
        self._members: list[str] = []
        self._size = 0
        self._names = set[str]()
        self._names_length = 0
        self._parser = parser = expat.ParserCreate()
        parser.StartElementHandler = self._start
        parser.EndElementHandler = self._end

    def see(self, piece: bytes) -> None:
        """Look at the next piece; the first one holds the method. Raises XmlRpcError."""
        super().see(piece)
        self._parse(piece)

    def end(self) -> None:
        """All of it was seen. Raises XmlRpcError if it should not have ended."""
        self._parse(b"", last=True)

    def passes(self, body: bytes) -> bool:
        """Whether a whole document passes at a glance; expat takes twenty times as long."""
        methods = fast.methods_of_multicall(body)
        return methods is not None and all(map(self._passes, methods))

    def _passes(self, method: str) -> bool:
        return method != MULTICALL and self._may_pass(method)

    def _parse(self, piece: bytes, last: bool = False) -> None:
        try:
            self._parser.Parse(piece, last)
        except expat.ExpatError as error:
            text = f"the document is not well-formed XML: {error}"
            raise XmlRpcError(PARSE_ERROR, text) from None
        self._size += len(piece)
        if self._size - self._parser.CurrentByteIndex > LONGEST_MARKUP:
            text = f"a long {MULTICALL} has a tag or comment of more than {LONGEST_MARKUP} bytes"
            raise XmlRpcError(PARSE_ERROR, text)

    def _start(self, name: str, attributes: Collection[str]) -> None:
        self._note_names((name, *attributes))
        self._depth += 1
        if self._depth > DEPTH:
            raise XmlRpcError(PARSE_ERROR, f"the document is nested deeper than {DEPTH} elements")
        if self._depth > _CONTENT_DEPTH:
            return
        if name not in _LEVELS[self._depth - 1]:
            text = f"a long {MULTICALL} has the element <{name[:40]}> in a wrong place"
            raise XmlRpcError(INVALID_REQUEST, text)
        if self._depth == _VALUE_DEPTH:
            self._has_call = False
        elif self._depth == _CALL_DEPTH:
            self._has_call = True
            self._members = []
        elif self._depth == _MEMBER_DEPTH:
            self._elements = []
        elif self._depth >= _FIELD_DEPTH:
            self._elements.append(name)
            self._text = ""
            # An array holds the parameters, which may be long: no text of theirs is collected.
            self._parser.CharacterDataHandler = None if name == "array" else self._add_text

    def _note_names(self, names: Iterable[str]) -> None:
        for name in names:
            if name not in self._names:
                self._names.add(name)
                self._names_length += len(name)
        if self._names_length > LONGEST_NAMES:
            text = f"the names of elements and attributes in a long {MULTICALL} have more than"
            raise XmlRpcError(PARSE_ERROR, f"{text} {LONGEST_NAMES} characters together")

    def _end(self, name: str) -> None:
        if self._depth == _FIELD_DEPTH and name == "name":
            self._elements[-1] += f":{self._text}"
        elif self._depth == _MEMBER_DEPTH:
            self._end_member()
        elif self._depth == _CALL_DEPTH and sorted(self._members) != ["methodName", "params"]:
            raise XmlRpcError(
                INVALID_REQUEST, f"a call in {MULTICALL} needs one methodName and one params"
            )
        elif self._depth == _VALUE_DEPTH and not self._has_call:
            raise XmlRpcError(INVALID_REQUEST, f"a call in {MULTICALL} is not a struct")
        if self._depth in (_FIELD_DEPTH, _CONTENT_DEPTH):
            self._parser.CharacterDataHandler = None
        self._depth -= 1

    def _end_member(self) -> None:
        if self._elements == _PARAMS:
            self._members.append("params")
        elif self._elements in (_METHOD, [*_METHOD, "string"]):
            self._members.append("methodName")
            if not self._passes(self._text):
                raise XmlRpcError(
                    INVALID_REQUEST, f"{self._text} is not allowed in a long {MULTICALL}"
                )
        else:
            raise XmlRpcError(
                INVALID_REQUEST,
                f"a call in a long {MULTICALL} has a member other than methodName and params",
            )

    def _add_text(self, text: str) -> None:
        self._text += text
        if len(self._text) > HEAD:
            text = f"a long {MULTICALL} has a name of more than {HEAD} characters"
            raise XmlRpcError(INVALID_REQUEST, text)


def cut(body: bytes) -> Iterator[bytes]:
    """A body in pieces that are each watched in some milliseconds."""
    return (body[start : start + SHORT] for start in range(0, len(body), SHORT))
