"""Answers that operators accept from proxies, which may be hostile."""

import gzip
from collections.abc import AsyncIterator, Callable

import pytest
from aiohttp import web

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.documents.status_document import ProxyStatus
from rosproxy_operator.common import proxy_client
from rosproxy_operator.common.proxy_client import ProxyClient, ProxyError


class Evil:
    """A hostile program at a proxy's address, with the same ``answer`` to all requests."""

    def __init__(self) -> None:
        self.answer: Callable[[], web.Response] = web.Response
        self.asked: list[str] = []
        self.admin = HostPort("", 0)

    async def serve(self, request: web.Request) -> web.StreamResponse:
        self.asked.append(request.path)
        return self.answer()


@pytest.fixture
async def evil() -> AsyncIterator[Evil]:
    evil = Evil()
    application = web.Application()
    application.router.add_route("*", "/{path:.*}", evil.serve)
    runner = web.AppRunner(application)
    await runner.setup()
    await web.TCPSite(runner, "127.0.0.1", 0).start()
    evil.admin = HostPort(*runner.addresses[0])
    yield evil
    await runner.cleanup()


@pytest.fixture
async def client() -> AsyncIterator[ProxyClient]:
    client = ProxyClient()
    yield client
    await client.close()


async def test_a_redirect_is_not_followed(evil: Evil, client: ProxyClient) -> None:
    evil.answer = lambda: web.Response(status=307, headers={"Location": "/secrets"})
    with pytest.raises(ProxyError, match="HTTP 307"):
        await client.status(evil.admin)
    assert evil.asked == ["/status"]


async def test_nothing_is_inflated(evil: Evil, client: ProxyClient) -> None:
    body = gzip.compress(b'{"nodes": []}')
    evil.answer = lambda: web.Response(body=body, headers={"Content-Encoding": "gzip"})
    with pytest.raises(ProxyError, match="not from a rosproxy"):
        await client.status(evil.admin)


@pytest.mark.parametrize("status", [200, 500])
async def test_a_long_answer_is_not_read(
    evil: Evil, client: ProxyClient, status: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error says that the proxy's answer is too long, not that another program answers."""
    monkeypatch.setattr(proxy_client, "MOST_STATUS_BYTES", 1000)
    evil.answer = lambda: web.Response(status=status, body=b"[" * 1001)
    for asking, path in (
        (client.status(evil.admin), "/status"),
        (client.changes(evil.admin, "token", "", 0.0), "/status/changes"),
    ):
        with pytest.raises(ProxyError) as raised:
            await asking
        assert str(raised.value) == (
            f"{evil.admin} answers more than 1000 bytes to GET {path}: the proxy is of another "
            "release, or compromised"
        )
        assert raised.value.is_unreadable
        assert not raised.value.is_unreachable


async def test_what_is_no_text_is_no_answer(evil: Evil, client: ProxyClient) -> None:
    evil.answer = lambda: web.Response(body=b"\xff\xfe", content_type="application/json")
    with pytest.raises(ProxyError, match="not from a rosproxy"):
        await client.status(evil.admin)


async def test_an_answer_without_a_bottom_is_no_answer(evil: Evil, client: ProxyClient) -> None:
    """The RecursionError must not end the operator's task or the live page of all proxies."""
    deep = "[" * 100_000
    evil.answer = lambda: web.Response(text=f'{{"nodes": {{}}, "links": {{}}, "x": {deep}')
    admin = evil.admin
    for asking in (
        client.status(admin),
        client.changes(admin, "token", "", 0.0),
        client.document(admin, "token"),
    ):
        with pytest.raises(ProxyError, match="not from a rosproxy"):
            await asking
    evil.answer = lambda: web.Response(text=deep[: proxy_client.MOST_ANSWER_BYTES])
    for telling in (client.send_containers(admin, "token", {}), client.retire(admin, "token")):
        with pytest.raises(ProxyError, match="not from a rosproxy"):
            await telling
    page = await client.documents({"evil": (admin, ""), "gone": (HostPort("127.0.0.1", 1), "")})
    assert [type(answer) for answer in page.values()] == [str, str]


async def test_an_answer_to_update_is_short(evil: Evil, client: ProxyClient) -> None:
    evil.answer = lambda: web.Response(
        text=f'{{"moved": "{"x" * proxy_client.MOST_ANSWER_BYTES}"}}'
    )
    with pytest.raises(ProxyError, match="answers more than 65536 bytes"):
        await client.send_containers(evil.admin, "token", {})


async def test_a_long_version_is_not_sent_back(evil: Evil, client: ProxyClient) -> None:
    """Each question for changes had a URL of 2.7 MB, and took the event loop 0.1 s."""
    versions = iter(["x" * 16, "%" * 900_000])
    evil.answer = lambda: web.json_response({"version": next(versions), "status": {"settings": {}}})
    assert await client.changes(evil.admin, "token", "", 0.0) == ("x" * 16, ProxyStatus())
    with pytest.raises(ProxyError, match="not from a rosproxy"):
        await client.changes(evil.admin, "token", "", 0.0)


@pytest.mark.parametrize(
    "text", ['{"settings": {"udp": "\\ud800"}}', '{"settings": {"\\ud800": 1}}']
)
async def test_half_of_a_surrogate_pair(evil: Evil, client: ProxyClient, text: str) -> None:
    evil.answer = lambda: web.Response(text=text)
    assert await client.status(evil.admin) == ProxyStatus()
