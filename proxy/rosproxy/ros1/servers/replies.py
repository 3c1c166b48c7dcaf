"""What an XML-RPC server writes to a connection: replies, invitations, resets."""

from aiohttp import HttpVersion, HttpVersion11, web

from rosproxy.net.http_client import pieces
from rosproxy.net.sockets import reset_on_close


class DocumentReply(web.StreamResponse):
    """An XML-RPC document with status 200; of a long one, of ``size`` bytes, the beginning.

    Its header is written here: aiohttp takes about as long for one as reading a document takes.
    """

    def __init__(self, document: bytes, size: int | None = None) -> None:
        super().__init__()
        self._document = document
        self._size = len(document) if size is None else size
        self._lasts = self._sent = False

    @property
    def keep_alive(self) -> bool:
        """Whether the connection serves another request; aiohttp asks once the reply is sent."""
        return self._lasts

    async def prepare(self, request: web.BaseRequest) -> None:
        """Send it all, the first time. Raises ConnectionError."""
        # aiohttp prepares what a handler returns once more (web_protocol.py, finish_response).
        if self._sent:
            return
        self._sent = True
        self._lasts = request.keep_alive
        head = _head(request.version, self._lasts, self._size)
        for piece in pieces(head, self._document):
            await request.writer.write(piece)
        await request.writer.drain()

    async def write_eof(self, data: bytes = b"") -> None:
        """Nothing is left to send."""


def invite(request: web.BaseRequest) -> None:
    """Ask for the body, if the client waits to be asked."""
    waits = request.headers.get("Expect", "").lower() == "100-continue"
    if waits and request.version >= HttpVersion11 and request.transport is not None:
        request.transport.write(b"HTTP/1.1 100 Continue\r\n\r\n")


def refuse(request: web.BaseRequest) -> web.StreamResponse:
    """Reset the connection: what a caller finds whose peer is gone; ROS's clients try again."""
    transport = request.transport
    if transport is not None:
        reset_on_close(transport.get_extra_info("socket"))
        transport.abort()
    return web.Response(status=503)  # aiohttp needs a response; this one is never sent


def _head(version: HttpVersion, lasts: bool, size: int) -> bytes:
    """A reply's header; that the connection lasts is said where HTTP's version doesn't imply it."""
    lines = f"HTTP/{version.major}.{version.minor} 200 OK\r\nContent-Type: text/xml\r\n"
    if lasts != (version >= HttpVersion11):
        lines += f"Connection: {'keep-alive' if lasts else 'close'}\r\n"
    # roscpp finds the length only with a blank after the colon (XmlRpcClient.cpp, readHeader).
    return f"{lines}Content-Length: {size}\r\n\r\n".encode()
