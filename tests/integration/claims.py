"""Remainders of former proxies at a master: registrations of gone nodes."""

from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager

from examples.demo.fake_http import End, FakeHttpServer, FakeRequest
from examples.demo.fake_master import FakeMaster
from tests.integration.net import HOST, rpc


async def claim(master: FakeMaster, name: str, port: int, inside: str, host: str = HOST) -> None:
    """Register at the master what a former proxy of ``host`` would have registered."""
    uri = f"http://{host}:{port}/{inside}/"
    await rpc(master.uri, "registerPublisher", name, "/t", "x/Y", uri)
    await rpc(master.uri, "registerService", name, f"{name}/s", f"rosrpc://{host}:{port}", uri)


@asynccontextmanager
async def silent_servers(address: str, count: int) -> AsyncIterator[list[FakeHttpServer]]:
    """Programs that take connections and never say a word, as a lost container seems to."""

    async def hang(_: FakeRequest) -> End:
        return End.HANG

    async with AsyncExitStack() as stack:
        made = [FakeHttpServer(hang) for _ in range(count)]
        for server in made:
            await server.start(address)
            stack.push_async_callback(server.stop)
        yield made
