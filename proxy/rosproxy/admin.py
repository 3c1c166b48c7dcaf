"""The admin endpoint: health, readiness, metrics and status, on loopback by default."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

from aiohttp import web
from prometheus_client import CollectorRegistry
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest

from rosproxy.core.uris import HostPort

GREETING = "rosproxy: /healthz /readyz /metrics /status\n"


class Admin:
    """Serves what operators and orchestrators ask.

    ``ready`` gives None or the reason why not; ``probe`` makes the check behind ``POST /probe``.
    """

    def __init__(
        self,
        metrics: CollectorRegistry,
        status: Callable[[], dict[str, Any]],
        ready: Callable[[], str | None],
        probe: Callable[[], Awaitable[dict[str, Any]]],
    ) -> None:
        self._metrics, self._status, self._ready, self._probe = metrics, status, ready, probe
        self._runner: web.AppRunner | None = None
        self._probing = asyncio.Lock()

    async def start(self, where: HostPort) -> None:
        """Listen. Raises OSError."""
        app = web.Application()
        app.router.add_get("/", self._greet)
        app.router.add_get("/healthz", self._healthz)
        app.router.add_get("/readyz", self._readyz)
        app.router.add_get("/metrics", self._get_metrics)
        app.router.add_get("/status", self._get_status)
        app.router.add_post("/probe", self._post_probe)
        self._runner = web.AppRunner(app, access_log=None)
        await self._runner.setup()
        await web.TCPSite(self._runner, where.host, where.port).start()

    async def stop(self) -> None:
        """Stop listening."""
        if self._runner is not None:
            await self._runner.cleanup()

    async def _greet(self, request: web.Request) -> web.Response:
        return web.Response(text=GREETING)

    async def _healthz(self, request: web.Request) -> web.Response:
        return web.Response(text="ok\n")

    async def _readyz(self, request: web.Request) -> web.Response:
        reason = self._ready()
        return web.Response(status=503 if reason else 200, text=f"{reason or 'ok'}\n")

    async def _get_metrics(self, request: web.Request) -> web.Response:
        body = generate_latest(self._metrics)
        return web.Response(body=body, headers={"Content-Type": CONTENT_TYPE_LATEST})

    async def _get_status(self, request: web.Request) -> web.Response:
        return web.json_response(self._status())

    async def _post_probe(self, request: web.Request) -> web.Response:
        """One probe at a time: each takes ports of the range."""
        async with self._probing:
            return web.json_response(await self._probe())
