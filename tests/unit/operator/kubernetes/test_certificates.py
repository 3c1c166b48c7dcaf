"""The webhook's certificate: made, kept, renewed, trusted and served without a gap."""

import asyncio
import base64
import contextlib
import socket
import ssl
from collections.abc import AsyncGenerator, AsyncIterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from cryptography import x509

from examples.demo.fake_http import free_ports
from rosproxy.shared.addresses import HostPort
from rosproxy_operator.common.operator_metrics import ClusterMetrics
from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.kubernetes.api.api_client import Api, ApiError
from rosproxy_operator.kubernetes.resources.model import Name
from rosproxy_operator.kubernetes.status.events import stamp
from rosproxy_operator.kubernetes.webhook import certificates, rotation, webhook_server
from rosproxy_operator.kubernetes.webhook.certificates import InvalidCertificate, KeyPair
from rosproxy_operator.kubernetes.webhook.rotation import (
    CertificateDirectory,
    CertificateRotation,
    SelfSigned,
)
from rosproxy_operator.kubernetes.webhook.webhook_server import WebhookServer
from tests.unit.operator.kubernetes.api_server import ApiServer

NAMES = certificates.service_names("ns", "wh")
HOST = "wh.ns.svc"
SECRET = Name("ns", "wh")
NOW = datetime.now(UTC).replace(microsecond=0)


class Clock:
    """A clock that only tests move."""

    def __init__(self) -> None:
        self.time = NOW

    def __call__(self) -> datetime:
        return self.time

    def forward(self, **by: float) -> None:
        self.time += timedelta(**by)


def put(server: ApiServer, data: dict[str, str] | None = None) -> None:
    server.put("secrets", {"metadata": {"name": "wh"}, **({"data": data} if data else {})})
    hooks = [{"name": f"{n}.rosproxy.io", "clientConfig": {"service": {}}} for n in ("wire", "b")]
    server.put("mutatingwebhookconfigurations", {"metadata": {"name": "wh"}, "webhooks": hooks})


def bundle(server: ApiServer) -> bytes:
    hooks = server.get("mutatingwebhookconfigurations", "wh", "")["webhooks"]
    bundles = {hook["clientConfig"].get("caBundle", "") for hook in hooks}
    assert len(bundles) == 1
    return base64.b64decode(bundles.pop())


def source(api: Api, clock: Clock) -> SelfSigned:
    return SelfSigned(api, NAMES, SECRET, "wh", clock)


@contextlib.asynccontextmanager
async def served(pair: KeyPair) -> AsyncIterator[tuple[int, ssl.SSLContext]]:
    """Run a TLS server on loopback. Yield the port and the context."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    certificates.load(context, pair)

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"hello")
        writer.close()

    listening = await asyncio.start_server(answer, "127.0.0.1", 0, ssl=context)
    try:
        yield listening.sockets[0].getsockname()[1], context
    finally:
        listening.close()
        await listening.wait_closed()


def call(port: int, authorities: bytes, host: str = HOST) -> bytes:
    """The answer for a client, such as an API server, that trusts these CAs alone."""
    context = ssl.create_default_context(cadata=authorities.decode())
    with (
        socket.create_connection(("127.0.0.1", port), 5) as plain,
        context.wrap_socket(plain, server_hostname=host) as secure,
    ):
        secure.sendall(b"GET / HTTP/1.0\r\n\r\n")
        return secure.recv(100)


@pytest.mark.parametrize("host", NAMES)
async def test_a_real_handshake(host: str) -> None:
    pair = certificates.make(NAMES, NOW)
    async with served(pair) as (port, _):
        assert await in_thread(call, port, pair.ca, host) == b"hello"


async def test_another_ca_or_name_is_refused() -> None:
    pair = certificates.make(NAMES, NOW)
    other = certificates.make(NAMES, NOW)
    async with served(pair) as (port, _):
        with pytest.raises(ssl.SSLCertVerificationError):
            await in_thread(call, port, other.ca)
        with pytest.raises(ssl.SSLCertVerificationError):
            await in_thread(call, port, pair.ca, "example.org")


async def test_renewal_while_serving() -> None:
    """A client that trusts both CAs is served without a gap."""
    old = certificates.make(NAMES, NOW)
    new = certificates.make(NAMES, NOW, before=old.ca)
    async with served(old) as (port, context):
        assert await in_thread(call, port, new.ca) == b"hello"
        certificates.load(context, new)
        assert await in_thread(call, port, new.ca) == b"hello"
        with pytest.raises(ssl.SSLCertVerificationError):
            await in_thread(call, port, old.ca)


def test_due_after_two_thirds_of_its_life() -> None:
    pair = certificates.make(NAMES, NOW)
    assert pair.expires == NOW + timedelta(days=90)
    assert not pair.is_due(NOW + timedelta(days=59))
    assert pair.is_due(NOW + timedelta(days=61))


def test_old_cas_are_dropped_when_they_expire() -> None:
    first = certificates.make(NAMES, NOW)
    second = certificates.make(NAMES, NOW + timedelta(days=60), before=first.ca)
    third = certificates.make(NAMES, NOW + timedelta(days=120), before=second.ca)
    assert [pair.ca.count(b"BEGIN") for pair in (first, second, third)] == [1, 2, 2]


def test_a_secret_holds_it() -> None:
    pair = certificates.make(NAMES, NOW)
    assert certificates.read(pair.secret()) == pair


@pytest.mark.parametrize(
    "change",
    [
        {"tls.key": base64.b64encode(certificates.make(NAMES, NOW).key).decode()},
        {"tls.crt": "bm9uc2Vuc2U="},
        {"tls.crt": "?"},
        {"ca.crt": "bm9uc2Vuc2U="},
    ],
)
def test_what_is_no_pair_is_unfit(change: dict[str, str]) -> None:
    with pytest.raises(InvalidCertificate):
        certificates.read({**certificates.make(NAMES, NOW).secret(), **change})
    with pytest.raises(InvalidCertificate, match=r"no entry tls.crt"):
        certificates.read({})


async def test_made_kept_and_trusted(server: ApiServer, api: Api) -> None:
    put(server)
    pair = await in_thread(source(api, Clock()).refresh)
    assert certificates.read(server.get("secrets", "wh")["data"]) == pair
    assert bundle(server) == pair.ca


async def test_a_restart_finds_the_same(server: ApiServer, api: Api) -> None:
    put(server)
    first = await in_thread(source(api, Clock()).refresh)
    before = len(server.asked("PATCH", "secrets"))
    assert await in_thread(source(api, Clock()).refresh) == first
    assert len(server.asked("PATCH", "secrets")) == before
    assert len(server.asked("PATCH", "mutatingwebhookconfigurations")) == 1


async def test_a_certificate_that_cannot_be_written_is_kept(server: ApiServer, api: Api) -> None:
    """With a new certificate for each try, clients would not always trust the served
    certificate.
    """
    put(server)
    clock = Clock()
    self_signed = source(api, clock)
    old = await in_thread(self_signed.refresh)
    server.refuse("PATCH", "secrets", 500, "failed calling webhook")
    clock.forward(days=61)
    served = []
    for _ in range(4):
        served.append(await in_thread(self_signed.refresh))
        authorities = {c.subject for c in x509.load_pem_x509_certificates(bundle(server))}
        assert x509.load_pem_x509_certificate(served[-1].certificate).issuer in authorities
        assert len(authorities) == 2
        assert "The certificate is in memory only" in self_signed.problems[0].text
        clock.forward(seconds=20)
    assert served[0] == old
    assert served[1] != old
    assert len(set(served[1:])) == 1
    server.refusals.clear()
    assert await in_thread(self_signed.refresh) == served[-1]
    assert certificates.read(server.get("secrets", "wh")["data"]) == served[-1]


async def test_only_the_leading_operator_makes_the_certificate(server: ApiServer, api: Api) -> None:
    """A waiting operator is ready, because an upgrade waits for this before ending the leader."""
    put(server)
    leading = False
    self_signed = SelfSigned(api, NAMES, SECRET, "wh", Clock(), leads=lambda: leading)
    certificate_rotation = CertificateRotation(self_signed, ClusterMetrics())
    webhook = WebhookServer(HostPort("127.0.0.1", 0), certificate_rotation)
    assert webhook.unready()

    await certificate_rotation.refresh()
    assert (certificate_rotation.pair, webhook.unready()) == (None, None)
    assert server.asked("PATCH", "secrets") == []

    leading = True
    await certificate_rotation.refresh()
    assert certificate_rotation.pair == certificates.read(server.get("secrets", "wh")["data"])
    assert webhook.unready()


async def test_a_problem_is_not_solved_before_there_is_a_certificate(
    server: ApiServer, api: Api, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    put(server)
    leading = False
    self_signed = SelfSigned(api, NAMES, SECRET, "wh", Clock(), leads=lambda: leading)
    certificate_rotation = CertificateRotation(self_signed, ClusterMetrics())
    server.refuse("GET", "secrets", 500, "no etcd")
    await certificate_rotation.refresh()
    assert "no etcd" in caplog.text

    server.refusals.clear()
    await certificate_rotation.refresh()
    assert certificate_rotation.not_made_yet
    assert "webhook: solved" not in caplog.text
    leading = True
    await certificate_rotation.refresh()
    assert "webhook: solved" in caplog.text


async def test_renewed_and_trusted_before_it_is_served(server: ApiServer, api: Api) -> None:
    put(server)
    clock = Clock()
    self_signed = source(api, clock)
    first = await in_thread(self_signed.refresh)
    clock.forward(days=61)
    assert await in_thread(self_signed.refresh) == first
    second = certificates.read(server.get("secrets", "wh")["data"])
    assert second != first
    assert bundle(server) == second.ca
    assert second.ca.endswith(first.ca)
    clock.forward(seconds=5)
    assert await in_thread(self_signed.refresh) == first
    clock.forward(seconds=6)
    assert await in_thread(self_signed.refresh) == second


async def test_a_pair_that_replaces_a_waiting_pair_waits_for_its_own_ca(
    server: ApiServer, api: Api
) -> None:
    put(server)
    clock = Clock()
    self_signed = source(api, clock)
    first = await in_thread(self_signed.refresh)
    clock.forward(days=61)
    assert await in_thread(self_signed.refresh) == first
    clock.forward(seconds=9)
    third = certificates.make(NAMES, clock(), first.ca)
    put(server, dict(third.secret()))
    assert await in_thread(self_signed.refresh) == first
    clock.forward(seconds=9)
    assert await in_thread(self_signed.refresh) == first
    clock.forward(seconds=2)
    assert await in_thread(self_signed.refresh) == third


async def test_not_served_while_it_cannot_be_trusted(server: ApiServer, api: Api) -> None:
    put(server)
    clock = Clock()
    self_signed = source(api, clock)
    first = await in_thread(self_signed.refresh)
    clock.forward(days=61)
    server.refuse("PATCH", "mutatingwebhookconfigurations", 422, "no")
    for _ in range(3):
        clock.forward(minutes=1)
        assert await in_thread(self_signed.refresh) == first
    (problem,) = self_signed.problems
    assert problem.text == "MutatingWebhookConfiguration wh: no"
    server.refusals.clear()
    await in_thread(self_signed.refresh)
    clock.forward(seconds=11)
    assert await in_thread(self_signed.refresh) != first


async def test_a_ca_that_somebody_overwrites_is_written_again(server: ApiServer, api: Api) -> None:
    put(server)
    self_signed = source(api, Clock())
    pair = await in_thread(self_signed.refresh)
    hooks = server.get("mutatingwebhookconfigurations", "wh", "")["webhooks"]
    del hooks[0]["clientConfig"]["caBundle"]
    assert await in_thread(self_signed.refresh) == pair
    assert bundle(server) == pair.ca


@pytest.mark.parametrize("status", [403, 404])
async def test_without_the_secret_it_is_kept_in_memory(
    server: ApiServer, api: Api, status: int
) -> None:
    put(server)
    server.refuse("GET", "secrets", status, "no")
    self_signed = source(api, Clock())
    pair = await in_thread(self_signed.refresh)
    assert await in_thread(self_signed.refresh) == pair
    assert bundle(server) == pair.ca
    assert "The certificate is in memory only" in self_signed.problems[0].text


async def test_without_the_api_server_nothing_is_made(server: ApiServer, api: Api) -> None:
    put(server)
    server.refuse("GET", "secrets", 503, "starting")
    self_signed = source(api, Clock())
    with pytest.raises(ApiError):
        await in_thread(self_signed.refresh)
    server.refusals.clear()
    pair = await in_thread(self_signed.refresh)
    server.refuse("GET", "secrets", 503, "starting")
    assert await in_thread(self_signed.refresh) == pair


@pytest.mark.parametrize("data", [{"tls.key": "?"}, {"tls.crt": "", "tls.key": "eA=="}])
async def test_nonsense_in_the_secret_is_replaced(
    server: ApiServer, api: Api, data: dict[str, str]
) -> None:
    put(server, {**data, "other": "a2VwdA=="})
    pair = await in_thread(source(api, Clock()).refresh)
    stored = server.get("secrets", "wh")["data"]
    assert certificates.read(stored) == pair
    assert stored["other"] == "a2VwdA=="


async def test_one_for_other_names_is_replaced(server: ApiServer, api: Api) -> None:
    put(server, certificates.make(["old.ns.svc"], NOW).secret())
    pair = await in_thread(source(api, Clock()).refresh)
    assert pair.names() == set(NAMES)


async def test_who_writes_the_secret_first_has_the_right_one(server: ApiServer, api: Api) -> None:
    put(server)
    server.refuse("PATCH", "secrets", 409, "the object has been modified")
    self_signed = source(api, Clock())
    with pytest.raises(ApiError, match="another program has written Secret ns/wh"):
        await in_thread(self_signed.refresh)
    theirs = certificates.make(NAMES, NOW)
    put(server, theirs.secret())
    assert await in_thread(self_signed.refresh) == theirs


def write(directory: Path, pair: KeyPair) -> None:
    (directory / "tls.crt").write_bytes(pair.certificate)
    (directory / "tls.key").write_bytes(pair.key)


async def test_a_directory_is_read_again(tmp_path: Path) -> None:
    directory = CertificateDirectory(str(tmp_path))
    with pytest.raises(InvalidCertificate, match=r"--webhook-cert-dir: .*tls.crt: No such file"):
        directory.refresh()
    pair = certificates.make(NAMES, NOW)
    other = certificates.make(NAMES, NOW)
    write(tmp_path, pair)
    assert directory.refresh().certificate == pair.certificate
    write(tmp_path, other)
    assert directory.refresh().certificate == other.certificate


async def test_a_half_written_directory_keeps_the_one_before(tmp_path: Path) -> None:
    write(tmp_path, certificates.make(NAMES, NOW))
    certificate_rotation = CertificateRotation(
        CertificateDirectory(str(tmp_path)), ClusterMetrics()
    )
    await certificate_rotation.refresh()
    first = certificate_rotation.pair
    (tmp_path / "tls.crt").write_bytes(certificates.make(NAMES, NOW).certificate)
    await certificate_rotation.refresh()
    assert certificate_rotation.pair is first is not None


async def test_the_renewal_survives_mistakes(caplog: pytest.LogCaptureFixture) -> None:
    class Broken:
        every = 1.0
        problems = ()

        def refresh(self) -> KeyPair:
            raise RuntimeError("oops")

    certificate_rotation = CertificateRotation(cast(Any, Broken()), ClusterMetrics())
    await certificate_rotation.refresh()
    assert certificate_rotation.pair is None
    assert "the operator failed: RuntimeError('oops')" in caplog.text


async def test_the_server_knows_since_when_it_serves(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pod from the time before the first certificate was told that an operator was ready."""
    monkeypatch.setattr(webhook_server, "time", SimpleNamespace(time=NOW.timestamp))
    certificate_rotation = CertificateRotation(rotation.CertificateDirectory(""), ClusterMetrics())
    server = WebhookServer(HostPort("127.0.0.1", 0), certificate_rotation)
    assert server.serving_since() == ""
    certificate_rotation.pair = certificates.make(NAMES, NOW)

    async def answer(review: Any, **_: Any) -> Any:
        return {}

    serving: AsyncGenerator[Any] = cast(Any, server(answer))  # type: ignore[arg-type]
    await anext(serving)
    assert server.serving_since() == stamp(NOW.timestamp())
    await serving.aclose()
    assert server.serving_since() == ""


async def test_the_server_exchanges_its_certificate(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "rosproxy_operator.kubernetes.webhook.webhook_server.CERTIFICATE_CHECK_INTERVAL_S", 0.01
    )
    old = certificates.make(NAMES, NOW)
    new = certificates.make(NAMES, NOW, before=old.ca)
    port = free_ports(1)
    certificate_rotation = CertificateRotation(rotation.CertificateDirectory(""), ClusterMetrics())

    async def answer(review: Any, **_: Any) -> Any:
        return {}

    server = WebhookServer(HostPort("127.0.0.1", port), certificate_rotation)
    serving = server(answer)  # type: ignore[arg-type]
    started = asyncio.ensure_future(anext(serving))
    await asyncio.sleep(0.05)
    assert not started.done()  # there is no certificate yet
    certificate_rotation.pair = old
    await started
    keeping = asyncio.ensure_future(anext(serving))
    assert b"HTTP" in await in_thread(call, port, old.ca)
    certificate_rotation.pair = new

    def exchanged() -> bool:
        try:
            call(port, old.ca)
        except ssl.SSLCertVerificationError:
            return True
        return False

    async with asyncio.timeout(30):
        while not await in_thread(exchanged):
            await asyncio.sleep(0.01)
    assert b"HTTP" in await in_thread(call, port, new.ca)
    keeping.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await keeping
