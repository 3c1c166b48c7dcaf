"""Limits on the resources that a pod can take from the operator through the webhook."""

import asyncio
import gc
import json
import ssl
from asyncio import sslproto
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from typing import Any, cast

import kopf
import pytest

from examples.demo.fake_http import free_ports
from rosproxy.shared.addresses import HostPort
from rosproxy_operator.common.operator_metrics import ClusterMetrics
from rosproxy_operator.kubernetes.webhook import certificates, webhook_server
from rosproxy_operator.kubernetes.webhook.rotation import CertificateDirectory, CertificateRotation
from rosproxy_operator.kubernetes.webhook.webhook_server import WebhookServer
from tests.unit.operator.kubernetes.api_server import until

PAIR = certificates.make(["localhost"], certificates.now())
MOST_OF_SOURCE = 384
MOST_CONNECTIONS = 512
REVIEW = json.dumps({"request": {"uid": "u1"}}).encode()
Wire = tuple[asyncio.StreamReader, asyncio.StreamWriter]


class Callers:
    """Connections to a webhook, each from an address of the caller's choice."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._writers: list[asyncio.StreamWriter] = []

    async def connect(self, source: str, tls: bool = False) -> Wire:
        """Connect; without ``tls`` nothing is sent, so that the handshake does not begin."""
        context = ssl.create_default_context(cadata=PAIR.ca.decode()) if tls else None
        reader, writer = await asyncio.open_connection(
            "127.0.0.1",
            self._port,
            ssl=context,
            server_hostname="localhost" if tls else None,
            local_addr=(source, 0),
        )
        self._writers.append(writer)
        return reader, writer

    async def ask(self, size: int, body: bytes, source: str = "127.0.0.1") -> Wire:
        """Ask with a body of ``size`` bytes, of which ``body`` is sent."""
        reader, writer = await self.connect(source, tls=True)
        writer.write(b"POST /wire HTTP/1.1\r\nHost: x\r\nContent-Length: %d\r\n\r\n" % size + body)
        await writer.drain()
        return reader, writer

    def close(self) -> None:
        for writer in self._writers:
            writer.transport.abort()


@pytest.fixture
async def callers() -> AsyncIterator[Callers]:
    rotation = CertificateRotation(CertificateDirectory(""), ClusterMetrics())
    rotation.pair = PAIR
    port = free_ports(1)

    async def answer(_review: Any, **_: Any) -> Any:
        return {"response": {}}

    server = WebhookServer(HostPort("127.0.0.1", port), rotation)
    serving = aiter(server(cast(kopf.WebhookFn, answer)))
    await anext(serving)
    callers = Callers(port)
    yield callers
    callers.close()
    await serving.aclose()  # type: ignore[attr-defined]


@contextmanager
def without_garbage_collection() -> Iterator[None]:
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def handshakes() -> int:
    """The number of the server's TLS connections in memory, 256 KiB each."""
    return sum(isinstance(thing, sslproto.SSLProtocol) for thing in gc.get_objects())


async def status_of(wire: Wire) -> int:
    return int((await wire[0].readline()).split()[1])


async def test_an_address_ends_its_own_oldest_connection(callers: Callers) -> None:
    """1,000 idle connections of a pod took 300 MB."""
    with without_garbage_collection():
        other = await callers.connect("127.0.6.2")
        wires = [await callers.connect("127.0.6.1") for _ in range(MOST_OF_SOURCE + 50)]
        await until(lambda: all(reader.at_eof() for reader, _ in wires[:50]))
        await until(lambda: handshakes() == MOST_OF_SOURCE + 1)
    assert not any(reader.at_eof() for reader, _ in (other, *wires[50:]))
    assert await status_of(await callers.ask(len(REVIEW), REVIEW)) == 200


async def test_of_many_addresses_the_one_with_most_loses(callers: Callers) -> None:
    few = [await callers.connect("127.0.6.1") for _ in range(100)]
    many = [await callers.connect("127.0.6.2") for _ in range(300)]
    others = [await callers.connect(f"127.0.7.{number}") for number in range(132)]
    ended = many[: 532 - MOST_CONNECTIONS]
    kept = [*few, *others, *many[532 - MOST_CONNECTIONS :]]
    await until(lambda: all(reader.at_eof() for reader, _ in ended))
    assert not any(reader.at_eof() for reader, _ in kept)


async def test_a_network_of_many_addresses_ends_its_own_connections(
    callers: Callers, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pod may have any number of IPv6 addresses."""

    def network(address: str) -> str:
        return "127.0.7.0/24" if address.startswith("127.0.7.") else address

    listener = "rosproxy_operator.kubernetes.webhook.tls_listener"
    monkeypatch.setattr(f"{listener}.MOST_CONNECTIONS", 6)
    monkeypatch.setattr(f"{listener}.subnet", network, raising=False)
    few = [await callers.connect("127.0.6.1") for _ in range(2)]
    crowd = [await callers.connect(f"127.0.7.{number}") for number in range(1, 11)]
    await until(lambda: all(reader.at_eof() for reader, _ in crowd[:6]))
    assert not any(reader.at_eof() for reader, _ in (*few, *crowd[6:]))


async def test_bodies_that_do_not_end_are_bounded(callers: Callers) -> None:
    """50 unfinished bodies of 8 MB took all memory of the operator."""
    share = webhook_server.MOST_HELD_BYTES_OF_SOURCE
    part = b"[" + b" " * (webhook_server.MOST_REQUEST_BYTES - 2)
    wires = [await callers.ask(len(part) + 1, part) for _ in range(share // len(part) + 1)]
    refused = {asyncio.ensure_future(status_of(wire)) for wire in wires}
    done, waiting = await asyncio.wait(refused, return_when=asyncio.FIRST_COMPLETED)
    assert {task.result() for task in done} == {503}
    for task in waiting:
        task.cancel()
    other = await callers.ask(len(REVIEW), REVIEW, "127.0.6.2")
    assert await status_of(other) == 200


@pytest.mark.parametrize(
    ("body", "status"),
    [
        (b"[" + b"[]," * (webhook_server.MOST_REQUEST_BYTES // 4) + b"[]]", 503),
        (b" " * (webhook_server.MOST_REQUEST_BYTES + 1), 413),
        (b"[" * 200_000, 400),
    ],
)
async def test_a_body_that_takes_much_memory_is_refused(
    callers: Callers, body: bytes, status: int
) -> None:
    assert await status_of(await callers.ask(len(body), body)) == status


async def test_a_body_has_to_arrive_soon(callers: Callers, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(webhook_server, "BODY_TIMEOUT_S", 0.0)
    assert await status_of(await callers.ask(10, b"[")) == 408
