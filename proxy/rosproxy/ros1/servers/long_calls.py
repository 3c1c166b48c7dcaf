"""Calls that pass unread, because they have too many bytes or elements to read."""

import asyncio
from collections.abc import AsyncIterator
from typing import TYPE_CHECKING, Protocol

from aiohttp import StreamReader

from rosproxy.net.http_client import PIECE_TIMEOUT_S, LongReply
from rosproxy.net.http_server import BadBody
from rosproxy.ros1.clients.master_client import Unreachable
from rosproxy.ros1.protocol.xmlrpc.passing import CallWatch, cut

if TYPE_CHECKING:
    from rosproxy.ros1.servers.xmlrpc_server import IncomingCall


class LongCall:
    """A call with a known method, whose body of ``size`` bytes may still be arriving.

    ``head`` is the part of the body that has arrived, ``rest`` the stream with the rest.
    """

    def __init__(
        self, method: str, size: int, head: bytes, rest: StreamReader, watch: CallWatch
    ) -> None:
        self.method = method
        self.size = size
        self._head = head
        self._rest = rest
        self._watch = watch

    async def pieces(self) -> AsyncIterator[bytes]:
        """The pieces of the body. The last piece comes after the whole body has been watched.

        Raises XmlRpcError if the call must not pass, Unreachable if the caller does not send the
        body.
        """
        if len(self._head) == self.size and self._watch.passes(self._head):
            yield self._head
            return
        await self._see(self._head)
        # Each piece waits for the next piece. rosmaster and nodes read the whole body before
        # parsing. So a refused call without the last piece has no effect.
        previous = self._head
        while not self._rest.at_eof():
            try:
                async with asyncio.timeout(PIECE_TIMEOUT_S):
                    piece = await self._rest.readany()
            except (OSError, BadBody) as error:  # a TimeoutError is an OSError
                raise Unreachable(f"the caller did not send the whole body: {error}") from error
            await self._see(piece)
            yield previous
            previous = piece
        self._watch.end()
        yield previous

    async def _see(self, part: bytes) -> None:
        """Watch a part of the body. Other tasks run after each piece."""
        for piece in cut(part):
            self._watch.see(piece)
            await asyncio.sleep(0)


class LongCalls(Protocol):
    """How a service handles long calls that the proxy need not read."""

    def watch(self, method: str, size: int) -> CallWatch | None:
        """The watch for a long call that may pass unread; None if the proxy must read the call."""

    async def pass_on(self, call: "IncomingCall", long_call: LongCall) -> bytes | LongReply:
        """The reply to a call; ``call`` names the caller. Raises XmlRpcError, Unreachable."""
