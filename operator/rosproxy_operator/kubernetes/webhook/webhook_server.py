"""Serving the admission webhook for kopf, with a certificate that may change any time.

`kopf.WebhookServer` does not do: even with an SSL context of ours it makes a certificate of its own
unless it is given files, and it closes its port to exchange one.
"""

import asyncio
import json
import logging
import ssl
from collections.abc import AsyncIterator

import kopf
from aiohttp import web

from rosproxy.net.addresses import HostPort, plain_address
from rosproxy.net.bounded_server import IDLE_TIMEOUT
from rosproxy.net.budget import Budget, Charge, OverBudget
from rosproxy.net.http_client import TooLong, read_bounded
from rosproxy_operator.kubernetes.webhook import certificates
from rosproxy_operator.kubernetes.webhook.certificates import KeyPair
from rosproxy_operator.kubernetes.webhook.injector import NOT_WIRED
from rosproxy_operator.kubernetes.webhook.rotation import CertificateRotation
from rosproxy_operator.kubernetes.webhook.tls_listener import TlsListener

log = logging.getLogger(__name__)

CHECK = 0.5
"""Seconds between two looks whether there is another certificate to serve."""
MOST = 4 * 2**20
"""Bytes of a request: the API server takes objects of 3 MiB. The review of a new pod holds one.

k8s.io/apiserver, pkg/server/config.go: MaxRequestBodyBytes.
"""
MOST_HELD = 96 * 2**20
"""Bytes of all requests that are read and answered at the same time, with `VALUE_SIZE`."""
MOST_HELD_OF_SOURCE = 32 * 2**20
"""The same of one address. A review of 20 KB counts as 80 KB."""
VALUE_SIZE = 100
"""Bytes that a value of a JSON document takes in memory, besides its text."""
BODY_TIMEOUT_S = 10.0
"""Seconds in which a body must have arrived. An API server sends one at once."""
ENDING = 2.0
"""Seconds that requests have to be answered when serving ends."""


class WebhookServer:
    """What kopf takes as ``settings.admission.server``.

    The certificate is exchanged in the event loop that does the handshakes, and therefore never
    in the midst of one. Connections that stand go on.
    """

    def __init__(self, bind: HostPort, rotation: CertificateRotation) -> None:
        self._bind = bind
        self._rotation = rotation
        self._serving = False
        self._draining = False

    def unready(self) -> str | None:
        """Why pods are not wired here; None if they are. May be asked from any thread.

        While there is no certificate no operator wires pods, and the leader may have to end first.
        """
        if self._serving or self._rotation.not_made_yet:
            return None
        return "the operator does not serve the webhook yet"

    def drain(self) -> None:
        """Close each connection after its next response: serving ends soon."""
        self._draining = True

    async def __call__(self, fn: kopf.WebhookFn) -> AsyncIterator[kopf.WebhookClientConfig]:
        """Serve until cancelled."""
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        while (pair := self._rotation.pair) is None:  # noqa: ASYNC110 - set in another thread
            await asyncio.sleep(CHECK)
        certificates.load(context, pair)
        application = _application(fn)
        application.on_response_prepare.append(self._prepare)
        runner = web.AppRunner(
            application,
            access_log=None,
            shutdown_timeout=ENDING,
            keepalive_timeout=IDLE_TIMEOUT,
            # Nothing is inflated: a small body may become a very large one.
            auto_decompress=False,
        )
        await runner.setup()
        assert runner.server is not None  # noqa: S101 - `setup` has made it
        listener = TlsListener(runner.server, context)
        try:
            bind = self._bind
            listener.start(bind)
            log.info("webhook started: https://%s", bind)
            self._serving = True
            # For kopf's own webhook configuration, of which there is none (`admission.managed`).
            yield kopf.WebhookClientConfig(url=f"https://{bind}")
            await self._exchange(context, pair)
        finally:
            self._serving = False
            await listener.close()
            await runner.cleanup()

    async def _prepare(self, _: web.Request, response: web.StreamResponse) -> None:
        if self._draining:
            response.force_close()

    async def _exchange(self, context: ssl.SSLContext, served: KeyPair) -> None:
        """Serve another certificate as soon as there is one."""
        while True:
            await asyncio.sleep(CHECK)
            pair = self._rotation.pair
            if pair is not None and pair != served:
                try:
                    certificates.load(context, pair)
                except ssl.SSLError:
                    log.exception(
                        "webhook certificate not replaced: the new certificate is unusable"
                    )
                served = pair  # also if it can't be: it would fail, and be logged, at each look


def _application(fn: kopf.WebhookFn) -> web.Application:
    held = Budget(MOST_HELD, MOST_HELD_OF_SOURCE, "bytes of reviews")

    async def serve(request: web.Request) -> web.Response:
        with Charge(held, plain_address(request.remote or "")) as charge:
            try:
                body = await _read_body(request, charge)
            except OverBudget as error:
                return web.Response(status=503, text=f"{error}\n")
            except TooLong as error:
                return web.Response(status=413, text=f"{error}\n")
            except TimeoutError:
                text = f"the body took over {BODY_TIMEOUT_S:g} s\n"
                return web.Response(status=408, text=text)
            return await _answer(fn, body, request.match_info["id"])

    application = web.Application()
    application.router.add_post("/{id}", serve)
    return application


async def _read_body(request: web.Request, charge: Charge) -> bytes:
    """The body of a request, charged. Raises OverBudget, TooLong, TimeoutError."""
    async with asyncio.timeout(BODY_TIMEOUT_S):
        body = await read_bounded(request.content, MOST, charge.add)
    charge.add(VALUE_SIZE * sum(map(body.count, (b"{", b"[", b","))))
    return body


async def _answer(fn: kopf.WebhookFn, body: bytes, webhook: str) -> web.Response:
    try:
        review = json.loads(body)
        uid = review["request"]["uid"]
    except (ValueError, TypeError, KeyError, RecursionError):
        return web.Response(status=400, text="the request is not an AdmissionReview\n")
    try:
        return web.json_response(await fn(review, webhook=webhook))
    except Exception as error:  # the pod passes as it is
        log.warning("pod not wired: the operator failed: %r", error)
        warning = f"{NOT_WIRED}the operator failed: {error!r}"[:200]
        response = {"uid": uid, "allowed": True, "warnings": [warning]}
        return web.json_response(
            {
                "apiVersion": review.get("apiVersion", "admission.k8s.io/v1"),
                "kind": review.get("kind", "AdmissionReview"),
                "response": response,
            }
        )
