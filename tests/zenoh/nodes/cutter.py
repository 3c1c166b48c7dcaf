"""A port before the robot's router, which ends each session a moment after its begin.

Arguments: the port, and the port of the router on this machine. After three seconds without a
connection, the program lets connections pass, and prints a line.
"""

import asyncio
import sys

LEFT_ALONE_S = 3.0
"""After the end of a session, the hub dials at once."""
OPENED_AFTER = 2
"""Messages of a router until a session is open: InitAck and OpenAck."""


class Cutter:
    """Whether connections pass, and the latest one."""

    def __init__(self, router: int) -> None:
        self.router = router
        self.passes = False
        self.dialed = asyncio.Event()

    async def take(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Connect a connection with the router."""
        self.dialed.set()
        answers, requests = await asyncio.open_connection("127.0.0.1", self.router)
        forth = asyncio.create_task(self._copy(reader, requests, None))
        await self._copy(answers, writer, None if self.passes else OPENED_AFTER)
        forth.cancel()
        for end in (writer, requests):
            end.close()

    async def _copy(
        self, source: asyncio.StreamReader, target: asyncio.StreamWriter, most: int | None
    ) -> None:
        while (most is None or most > 0) and (data := await source.read(65536)):
            target.write(data)
            await target.drain()
            most = None if most is None else most - 1


async def main() -> None:
    """Cut sessions until the hub dials no more; then pass all on."""
    port, router = map(int, sys.argv[1:])
    cutter = Cutter(router)
    server = await asyncio.start_server(cutter.take, port=port)
    print("cuts sessions")
    await cutter.dialed.wait()
    while cutter.dialed.is_set():
        cutter.dialed.clear()
        await asyncio.sleep(LEFT_ALONE_S)
    cutter.passes = True
    print("left alone")
    await server.serve_forever()


asyncio.run(main())
