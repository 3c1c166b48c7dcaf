"""Calls that are too long to be read whole, or have too many elements, and need not be read."""

import asyncio
from collections.abc import AsyncIterator
from typing import TYPE_CHECKING, Protocol

from aiohttp import StreamReader

from rosproxy.net.http_client import PIECE_TIMEOUT, LongReply
from rosproxy.net.http_server import BadBody
from rosproxy.ros1.clients.master_client import Unreachable
from rosproxy.ros1.protocol.xmlrpc.passing import CallWatch, cut

if TYPE_CHECKING:
    from rosproxy.ros1.servers.xmlrpc_server import IncomingCall


class LongCall:
    """A call whose method is known and whose body of ``size`` bytes may still be coming.

    ``head`` is what of it has come, ``rest`` brings the rest.
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
        """The body, watched; its last piece comes once all of it was.

        Raises XmlRpcError if it must not pass, Unreachable if the caller does not send it.
        """
        if len(self._head) == self.size and self._watch.passes(self._head):
            yield self._head
            return
        for piece in cut(self._head):  # others are served between two pieces
            self._watch.see(piece)
            await asyncio.sleep(0)
        # Always one piece behind: rosmaster and nodes read a body to its end before they look into
        # it, so without the last piece none of them acts on a call that is refused.
        previous = self._head
        while not self._rest.at_eof():
            try:
                async with asyncio.timeout(PIECE_TIMEOUT):
                    piece = await self._rest.readany()
            except (OSError, BadBody) as error:  # a time-out is one of the former
                raise Unreachable(f"the caller did not send the whole body: {error}") from error
            self._watch.see(piece)
            yield previous
            previous = piece
        self._watch.end()
        yield previous


class LongCalls(Protocol):
    """What a service does with long calls that it need not read."""

    def watch(self, method: str, size: int) -> CallWatch | None:
        """How to watch a call of a method while it passes; None if it has to be read."""

    async def pass_on(self, call: "IncomingCall", long_call: LongCall) -> bytes | LongReply:
        """The reply to a call; ``call`` says who makes it. Raises XmlRpcError, Unreachable."""
