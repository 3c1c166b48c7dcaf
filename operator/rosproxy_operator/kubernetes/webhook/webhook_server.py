"""Serves the admission webhook for kopf, with a certificate that may change at any time.

`kopf.WebhookServer` can't do this. Without certificate files, that class creates a certificate of
its own, even with a given SSL context. To replace a certificate, that class closes the port.
"""

import asyncio
import json
import logging
import ssl
import time
from collections.abc import AsyncIterator

import kopf
from aiohttp import web

from rosproxy.shared.addresses import HostPort, plain_address
from rosproxy.shared.connections.budget import Budget, Charge, OverBudget
from rosproxy.shared.http.bodies import TooLong, read_bounded
from rosproxy.shared.http.bounded_server import IDLE_TIMEOUT_S
from rosproxy_operator.kubernetes.planner.pods.wiring import UNWIRED
from rosproxy_operator.kubernetes.status.events import stamp
from rosproxy_operator.kubernetes.webhook import certificates
from rosproxy_operator.kubernetes.webhook.certificates import KeyPair
from rosproxy_operator.kubernetes.webhook.rotation import CertificateRotation
from rosproxy_operator.kubernetes.webhook.tls_listener import TlsListener

log = logging.getLogger(__name__)

CERTIFICATE_CHECK_INTERVAL_S = 0.5
"""Seconds between two checks for another certificate to serve."""
MOST_REQUEST_BYTES = 4 * 2**20
"""Bytes of a request at most. A review contains a pod, and the API server takes 3 MiB for a pod.

k8s.io/apiserver, pkg/server/config.go: MaxRequestBodyBytes.
"""
MOST_HELD_BYTES = 96 * 2**20
"""Bytes of all requests in memory at the same time, with `VALUE_BYTES` for each value."""
MOST_HELD_BYTES_OF_SOURCE = 32 * 2**20
"""Bytes of the requests of an address at most. A review of 20 KB counts as 80 KB."""
VALUE_BYTES = 100
"""Bytes that a value of a JSON document takes in memory, besides the text."""
BODY_TIMEOUT_S = 10.0
"""Seconds until the whole body must be there. An API server sends the body at once."""
END_TIMEOUT_S = 2.0
"""Seconds to answer open requests when serving ends."""


class WebhookServer:
    """The server for kopf's ``settings.admission.server``.

    The handshakes and the replacement of the certificate run in the same event loop. So the
    certificate never changes during a step of a handshake. Established connections go on.
    """

    def __init__(self, bind: HostPort, rotation: CertificateRotation) -> None:
        self._bind = bind
        self._rotation = rotation
        self._serving_since = ""
        self._draining = False

    def unready(self) -> str | None:
        """Why this operator is not ready to wire pods; None if ready. Any thread may ask.

        The answer is None as well while the leading operator has not created the certificate. In a
        rollout the leading operator may run without webhook, and ends only when this operator is
        ready.
        """
        if self._serving_since or self._rotation.not_made_yet:
            return None
        return "the operator does not serve the webhook yet"

    def serving_since(self) -> str:
        """Since when this operator serves the webhook, in RFC 3339; empty while it does not.

        Any thread may ask.
        """
        return self._serving_since

    def drain(self) -> None:
        """Close each connection after the next response, because serving ends soon."""
        self._draining = True

    async def __call__(self, fn: kopf.WebhookFn) -> AsyncIterator[kopf.WebhookClientConfig]:
        """Serve the handler ``fn`` of kopf until cancelled."""
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        while (pair := self._rotation.pair) is None:  # noqa: ASYNC110 - set in another thread
            await asyncio.sleep(CERTIFICATE_CHECK_INTERVAL_S)
        certificates.load(context, pair)
        application = _application(fn)
        application.on_response_prepare.append(self._prepare)
        runner = web.AppRunner(
            application,
            access_log=None,
            shutdown_timeout=END_TIMEOUT_S,
            keepalive_timeout=IDLE_TIMEOUT_S,
            # A small compressed body may become a very large body.
            auto_decompress=False,
        )
        await runner.setup()
        assert runner.server is not None  # noqa: S101 - `setup` has made it
        listener = TlsListener(runner.server, context)
        try:
            bind = self._bind
            listener.start(bind)
            log.info("webhook started: https://%s", bind)
            self._serving_since = stamp(time.time())
            # kopf needs the URL only for a configuration of its own (`admission.managed`).
            yield kopf.WebhookClientConfig(url=f"https://{bind}")
            await self._replace_certificates(context, pair)
        finally:
            self._serving_since = ""
            await listener.close()
            await runner.cleanup()

    async def _prepare(self, _: web.Request, response: web.StreamResponse) -> None:
        if self._draining:
            response.force_close()

    async def _replace_certificates(self, context: ssl.SSLContext, served: KeyPair) -> None:
        """Serve each new certificate within `CERTIFICATE_CHECK_INTERVAL_S` seconds."""
        while True:
            await asyncio.sleep(CERTIFICATE_CHECK_INTERVAL_S)
            pair = self._rotation.pair
            if pair is not None and pair != served:
                try:
                    certificates.load(context, pair)
                except ssl.SSLError:
                    log.exception(
                        "webhook certificate not replaced: the new certificate is unusable"
                    )
                served = pair  # an unusable pair, too: else each check would log the error


def _application(fn: kopf.WebhookFn) -> web.Application:
    held = Budget(MOST_HELD_BYTES, MOST_HELD_BYTES_OF_SOURCE, "bytes of reviews")

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
    """Read and charge the body of a request. Raises OverBudget, TooLong, TimeoutError."""
    async with asyncio.timeout(BODY_TIMEOUT_S):
        body = await read_bounded(request.content, MOST_REQUEST_BYTES, charge.add)
    charge.add(VALUE_BYTES * sum(map(body.count, (b"{", b"[", b","))))
    return body


async def _answer(fn: kopf.WebhookFn, body: bytes, webhook: str) -> web.Response:
    try:
        review = json.loads(body)
        uid = review["request"]["uid"]
    except (ValueError, TypeError, KeyError, RecursionError):
        return web.Response(status=400, text="the request is not an AdmissionReview\n")
    try:
        return web.json_response(await fn(review, webhook=webhook))
    except Exception as error:  # admit the pod unwired
        log.warning("pod not wired: the operator failed: %r", error)
        warning = f"{UNWIRED}the operator failed: {error!r}"[:200]
        response = {"uid": uid, "allowed": True, "warnings": [warning]}
        return web.json_response(
            {
                "apiVersion": review.get("apiVersion", "admission.k8s.io/v1"),
                "kind": review.get("kind", "AdmissionReview"),
                "response": response,
            }
        )
