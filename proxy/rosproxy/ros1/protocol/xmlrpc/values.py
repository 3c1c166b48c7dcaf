"""The values of XML-RPC documents, as `rosproxy.ros1.protocol.xmlrpc.document` finds them.

The methods of a value return edits of the document, and `document.apply` makes all edits at once.
"""

from dataclasses import dataclass, field
from typing import Literal
from xml.parsers import expat
from xml.sax.saxutils import escape

import msgspec

Kind = Literal["string", "int", "array", "struct", "other"]
KINDS: dict[str, Kind] = {
    "array": "array",
    "struct": "struct",
    "string": "string",
    **dict.fromkeys(("int", "i4", "i8"), "int"),
    **dict.fromkeys(("boolean", "double", "dateTime.iso8601", "base64", "nil"), "other"),
}
"""The kind of each element that may be inside a value (http://xmlrpc.com/spec.md). ``nil`` is an
extension."""
SCALARS = KINDS.keys() - {"array", "struct"}
"""The elements that hold text."""


class Edit(msgspec.Struct, frozen=True):
    """Replace the bytes ``start`` to ``end`` of a document by ``text``."""

    start: int
    end: int
    text: bytes


@dataclass(slots=True)
class Value:
    """A ``<value>``: the kind, the place in the document, and the content.

    ``outer`` spans the whole element, ``inner`` the text of a scalar; both are byte offsets.
    ``members`` are the names of a struct's members, in the order of ``items``. ``encoding`` is the
    encoding of the document.
    """

    body: bytes = field(repr=False)
    encoding: str = "utf-8"
    kind: Kind = "string"
    outer: tuple[int, int] = (0, 0)
    inner: tuple[int, int] = (0, 0)
    items: list["Value"] = field(default_factory=list)
    members: list[str] = field(default_factory=list)
    _text: str | None = field(default=None, init=False, repr=False, compare=False)

    @property
    def text(self) -> str:
        """The text of a scalar, with entities and CDATA resolved."""
        if self._text is None:
            start, end = self.inner
            self._text = text_of(self.body[start:end], self.encoding)
        return self._text

    @property
    def raw(self) -> bytes:
        """The whole element as sent, in UTF-8."""
        return self.body[slice(*self.outer)].decode(self.encoding).encode()

    def string(self) -> str | None:
        """The text if this is a string, else None."""
        return self.text if self.kind == "string" else None

    def integer(self) -> int | None:
        """The number if this is an int with a valid text, else None."""
        if self.kind != "int":
            return None
        try:
            return int(self.text)
        except ValueError:
            return None

    def member(self, name: str) -> "Value | None":
        """The value of a struct's member, or None."""
        return self.items[self.members.index(name)] if name in self.members else None

    def with_text(self, text: str) -> Edit:
        """The edit that changes the text of a scalar and keeps its type.

        If the scalar has this text already, in any notation, the edit changes no byte.
        """
        start, end = self.inner
        if text == self.text:
            return Edit(start, start, b"")
        raw = escape(text).encode(self.encoding, "xmlcharrefreplace")
        if self.body[start - 2 : start] == b"/>":  # <value/> and <string/> have no inside
            return self.replaced_by(b"<value>" + raw + b"</value>")
        return Edit(start, end, raw)

    def replaced_by(self, raw: bytes) -> Edit:
        """The edit that replaces the value by another raw value."""
        return Edit(*self.outer, raw)

    def removed(self) -> Edit:
        """The edit that removes the value from its array."""
        return self.replaced_by(b"")


def text_of(raw: bytes, encoding: str) -> str:
    """The text of a part of a document, with entities, CDATA and line ends resolved."""
    if b"&" not in raw and b"<" not in raw:
        text = raw.decode(encoding, "replace")
        return text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text
    pieces: list[str] = []
    parser = expat.ParserCreate(encoding)
    parser.CharacterDataHandler = pieces.append
    parser.Parse(b"<t>" + raw + b"</t>", True)
    return "".join(pieces)
