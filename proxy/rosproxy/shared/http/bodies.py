"""The bodies of HTTP requests and responses, read up to a bound."""

from collections.abc import Callable, Mapping

import aiohttp


class BadResponse(ValueError):
    """An HTTP response with a status other than 200, or with a compressed or too long body."""


class TooLong(BadResponse):
    """A body with more bytes than the bound."""

    def __init__(self, most: int) -> None:
        super().__init__(f"the body is longer than {most} bytes")


def is_plain(headers: Mapping[str, str]) -> bool:
    """Whether the headers announce a body without compression."""
    encoding = headers.get("Content-Encoding")
    return encoding is None or encoding.strip().lower() in ("identity", "")


async def read_bounded(
    stream: aiohttp.StreamReader, longest: int, hold: Callable[[int], None] | None = None
) -> bytes:
    """The whole body, of at most ``longest`` bytes.

    Calls ``hold`` with the size of each chunk before reading the next chunk. Raises TooLong, and
    the errors of ``hold``.
    """
    chunks = list[bytes]()
    size = 0
    while not stream.at_eof():
        chunk = stream.read_nowait() if stream.is_eof() else await stream.readany()
        size += len(chunk)
        if size > longest:
            raise TooLong(longest)
        if hold is not None:
            hold(len(chunk))
        chunks.append(chunk)
    return chunks[0] if len(chunks) == 1 else b"".join(chunks)
