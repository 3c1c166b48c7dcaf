"""Long calls without addresses, such as calls that set parameters: these calls pass unread.

The proxy reads the method from the head of the document, if the head has the form of ROS's clients.
The proxy reads a document with another head as a whole, within `limits`. While the rest of the
document passes, the proxy only watches for a second method name. The master or a node must not find
a method that the proxy has not judged. The proxy holds the last piece back until the whole document
has been watched. So no program acts on a refused document, because rosmaster and nodes parse a body
only after the whole body has arrived.

roslaunch sets parameters by ``system.multicall``. expat parses such a call piece by piece, and the
call passes if each inner call may pass. The document has to follow the grammar strictly. Python's
Unmarshaller (xmlrpc/client.py) has a stack and no grammar, so the Unmarshaller could find another
method in a document with another structure. A regular expression accepts the usual document in a
twentieth of the time (`fast.methods_of_multicall`).
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

PIECE_BYTES = 16 * 1024
"""Bytes that are watched before other tasks run. A piece full of tags takes about 10 ms."""
SHORT_BYTES = 64 * 1024
"""Bytes up to which the proxy reads any document as a whole, in some milliseconds."""
HEAD_BYTES = 4096
"""The bytes of a document in which the proxy looks for the method."""
MOST_DEPTH = 64
"""The highest number of nested elements in a multicall, as in `Limits`."""
LONGEST_MARKUP = 64 * 1024
"""The highest number of bytes of a tag, comment or processing instruction in a multicall. expat
buffers such markup until the markup is complete. Before version 2.6, expat starts again at the
beginning with each new piece."""
MOST_NAME_CHARACTERS = 4096
"""Characters of all names of elements and attributes in a multicall, each name counted once. The
parser keeps the names until the end of the document. XML-RPC has 20 names."""

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
# Without markup, references and bytes beyond ASCII, a text is the same in each encoding of _HEAD
# and for every parser.
_STRING_PARAM = re.compile(
    rb"\s*<param>\s*<value>(?:\s*<string>([^<&\x80-\xff]*)</string>\s*|([^<&\x80-\xff]*))"
    rb"</value>\s*</param>\s*"
)
# A prefix counts, too: Python's Unmarshaller drops prefixes (xmlrpc/client.py, end). NUL bytes mean
# UTF-16, which expat recognizes by itself. A search for bytes finds no name in UTF-16.
_FORBIDDEN = re.compile(rb"[<:]methodName[\s/>]|<!DOCTYPE|<!ENTITY|\0")
_HINTS = (b"methodName", b"<!DOCTYPE", b"<!ENTITY", b"\0")
"""Each forbidden text contains a hint. A search for hints first takes a hundredth of the time."""
_NESTING = re.compile(rb"<(/?)(?:array|struct)>")
_LONGEST_FORBIDDEN = len(b"<methodName>")
"""Bytes of the longest text in the search for forbidden texts."""
MOST_NESTED = 20
"""The highest number of nested arrays and structs. XmlRpc++ recurses for each level."""

_LEVELS = (
    {"methodCall"},
    {"methodName", "params"},
    *({name} for name in ("param", "value", "array", "data", "value", "struct", "member")),
    {"name", "value"},
    {"string", "array"},
)
"""The elements of a multicall, from the root down to the content of a call's members."""
_VALUE_DEPTH = 7
"""The depth of a value that holds a call."""
_CALL_DEPTH = 8
"""The depth of a call's struct."""
_MEMBER_DEPTH = 9
"""The depth of a call's members."""
_FIELD_DEPTH = 10
"""The depth of a member's name and value."""
_CONTENT_DEPTH = 11
"""The depth of the content of a member's value."""
_METHOD = ["name:methodName", "value"]
_PARAMS = ["name:params", "value", "array"]
"""The two members of a call, as `MulticallWatch` collects their elements and names."""


def method_of(head: bytes) -> str | None:
    """The method of a call, from the head of the document; None if the head has no method."""
    match = _HEAD.match(head, 0, HEAD_BYTES)
    return match[2].decode() if match else None


def first_strings(head: bytes, count: int) -> list[str | None]:
    """The first ``count`` parameters of a call, from the head of the document.

    From the first parameter on that is no plain string, or not in the head, all elements are None.
    """
    match = _HEAD.match(head, 0, HEAD_BYTES)
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
    """The ROS status of a reply, from the head; None if the head has no status."""
    match = _STATUS.match(head, 0, HEAD_BYTES)
    return int(match[2]) if match else None


class CallWatch:
    """Watches a passing document, from the head on: no second method, no deep nesting."""

    def __init__(self) -> None:
        self._tail: bytes | None = None
        self._nested = 0

    def see(self, piece: bytes) -> None:
        """Watch the next piece; the first piece has the method.

        Raises XmlRpcError for a forbidden text or too many nested levels.
        """
        if self._tail is None:
            head = _HEAD.match(piece)
            piece = piece[head.end() :] if head else piece
        text = (self._tail or b"") + piece
        match = _FORBIDDEN.search(text) if any(hint in text for hint in _HINTS) else None
        if match:
            token = match[0].decode("latin-1").strip("\0<:/> \t\r\n") or "a NUL byte"
            raise XmlRpcError(INVALID_REQUEST, f"{token} is not allowed inside a long call")
        for tag in _NESTING.finditer(text):
            if tag.end() <= len(self._tail or b""):  # seen with the last piece
                continue
            # Tags count everywhere, also in a comment or CDATA. A closing tag without an opening
            # tag must not make room for further levels.
            self._nested = max(self._nested - 1, 0) if tag[1] else self._nested + 1
            if self._nested > MOST_NESTED:
                raise XmlRpcError(
                    PARSE_ERROR, f"arrays and structs are nested deeper than {MOST_NESTED} levels"
                )
        # A forbidden text may begin here and end in the next piece.
        self._tail = text[1 - _LONGEST_FORBIDDEN :]

    def end(self) -> None:
        """End the watch after the last piece. Only `MulticallWatch` checks something here."""

    def passes(self, _body: bytes) -> bool:
        """Whether a whole document may pass without a watch."""
        return False


class MulticallWatch(CallWatch):
    """Watches a passing multicall; ``may_pass`` says whether calls of a method pass unread."""

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
        """Watch the next piece; the first piece has the method. Raises XmlRpcError."""
        super().see(piece)
        self._parse(piece)

    def end(self) -> None:
        """End the watch after the last piece. Raises XmlRpcError if the document is incomplete."""
        self._parse(b"", last=True)

    def passes(self, body: bytes) -> bool:
        """Whether a regular expression shows that a whole document may pass.

        False says nothing: expat then watches the document, which takes twenty times as long.
        """
        methods = fast.methods_of_multicall(body)
        return methods is not None and all(map(self._is_permitted, methods))

    def _is_permitted(self, method: str) -> bool:
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
        if self._depth > MOST_DEPTH:
            raise XmlRpcError(
                PARSE_ERROR, f"the document is nested deeper than {MOST_DEPTH} elements"
            )
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
            # An array has the parameters, which may be long, so their text is not collected.
            self._parser.CharacterDataHandler = None if name == "array" else self._add_text

    def _note_names(self, names: Iterable[str]) -> None:
        for name in names:
            if name not in self._names:
                self._names.add(name)
                self._names_length += len(name)
        if self._names_length > MOST_NAME_CHARACTERS:
            text = f"the names of elements and attributes in a long {MULTICALL} have more than"
            raise XmlRpcError(PARSE_ERROR, f"{text} {MOST_NAME_CHARACTERS} characters together")

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
            if not self._is_permitted(self._text):
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
        if len(self._text) > HEAD_BYTES:
            text = f"a long {MULTICALL} has a name of more than {HEAD_BYTES} characters"
            raise XmlRpcError(INVALID_REQUEST, text)


def cut(body: bytes) -> Iterator[bytes]:
    """A body in pieces of at most PIECE_BYTES."""
    return (body[start : start + PIECE_BYTES] for start in range(0, len(body), PIECE_BYTES))
