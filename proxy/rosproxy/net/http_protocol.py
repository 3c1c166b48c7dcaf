"""What the HTTP server and the HTTP client share: a connection that reads and writes messages.

aiohttp's parser (llhttp) reads the messages, and aiohttp's flow control keeps the peer from sending
more of a body than was read.
"""

import asyncio

from aiohttp.base_protocol import BaseProtocol

READ_AHEAD_BYTES = 64 * 1024
"""Bytes of a body that may wait to be read, before the peer has to wait."""
SEPARATE_BODY_BYTES = 64 * 1024
"""A body of at least this size is not copied to stand behind its header."""


class HttpProtocol(BaseProtocol):
    """A connection; ``gone`` once it is closed."""

    @property
    def gone(self) -> bool:
        """Whether the connection is closed."""
        return self.transport is None

    def resume_reading(self, resume_parser: bool = True) -> None:
        """Read on after a pause. aiohttp's streams call this after each body, paused or not."""
        if self._reading_paused:
            super().resume_reading(resume_parser)

    def write(self, data: bytes) -> None:
        """Send; nothing is sent on a connection that is gone."""
        if self.transport is not None:
            self.transport.write(data)

    def write_message(self, head: bytes, body: bytes) -> None:
        """Send a header and the body, in a single write unless that would copy a long body."""
        if len(body) < SEPARATE_BODY_BYTES:
            self.write(head + body)
        else:
            self.write(head)
            self.write(body)

    async def drain(self) -> None:
        """Wait until the peer has taken most of what was sent. Raises ConnectionError."""
        if self._paused or self.transport is None:
            await self._drain_helper()


def wake(waiter: asyncio.Future[None] | None) -> None:
    """Let the task that waits for a future go on. Do nothing for None or a future that is done."""
    if waiter is not None and not waiter.done():
        waiter.set_result(None)
