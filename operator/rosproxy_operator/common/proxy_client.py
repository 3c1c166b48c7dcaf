"""Asking and telling running proxies, over their admin endpoints."""

import errno
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import aiohttp
import msgspec

from rosproxy.access.layers import PolicyLayer, layers_as_json
from rosproxy.admin.status_document import NotAStatus, ProxyStatus, parse_status
from rosproxy.net.addresses import HostPort

Json = dict[str, Any]
WITHIN = 3.0
"""Seconds that a proxy has to answer."""
WITHIN_MASTER = 40.0
"""The same where it asks its master first, which may hang for 30 s."""


class ProxyError(Exception):
    """A proxy did not do what it was asked.

    ``away`` if nothing at all is there: no route, or no answer. ``later`` if it is well, but needs
    its master, which can't be asked now. ``status`` is that of an HTTP answer, 0 without one.
    """

    def __init__(self, message: str, away: bool = False, status: int = 0) -> None:
        super().__init__(message)
        self.away, self.status = away, status
        self.later = status == 503


class PolicyRefused(ProxyError):
    """A proxy does not take its policy; the message says what to do."""


class ProxyClient:
    """Calls the admin endpoints of proxies. Every call raises ProxyError."""

    def __init__(self) -> None:
        self._session: aiohttp.ClientSession | None = None

    async def status(self, where: HostPort) -> ProxyStatus:
        """What a proxy's ``/status`` says."""
        text = await self._ask("GET", where, "/status")
        try:
            return parse_status(text)
        except NotAStatus:
            raise _no_rosproxy(where) from None

    async def master_address(self, where: HostPort, token: str, address: str) -> None:
        """Tell where the master's host is now."""
        await self._ask("POST", where, "/master-address", token, {"address": address})

    async def containers(self, where: HostPort, token: str, body: Mapping[str, Any]) -> Json:
        """Tell which containers are gone, have moved or arrived; how many nodes that concerned."""
        text = await self._ask("POST", where, "/containers", token, body, WITHIN_MASTER)
        return _read(text, where)

    async def policy(self, where: HostPort, token: str, layers: Sequence[PolicyLayer]) -> None:
        """Tell the layers of its policy, instead of those told before. Raises PolicyRefused, too.

        They are in force at once; where its master can't be asked (503) the proxy goes on trying to
        tell it. A proxy of a former release has no policy, which is right if there is none.
        """
        try:
            body = {"layers": layers_as_json(layers)}
            await self._ask("POST", where, "/policy", token, body, WITHIN_MASTER)
        except ProxyError as error:
            if error.status == 404 and layers:
                text = (
                    "knows no policies, so that it is told of nobody new who may use it: its image "
                    "is that of a former release: let it have the operator's"
                )
                raise PolicyRefused(text, status=404) from None
            if error.status == 400:
                text = f"does not take its policy, and is told of nobody new till then: {error}"
                raise PolicyRefused(text, status=400) from None
            if error.status not in (404, 503):
                raise

    async def selected(self, where: HostPort, token: str, addresses: Collection[str]) -> None:
        """Tell which addresses may use it as their master: those of what its labels select."""
        await self._ask("POST", where, "/containers", token, {"selected": sorted(addresses)})

    async def retire(self, where: HostPort, token: str) -> Json:
        """Let it unregister everything it holds at the master."""
        return _read(await self._ask("POST", where, "/retire", token, {}, WITHIN_MASTER), where)

    async def close(self) -> None:
        """Close all connections."""
        if self._session is not None:
            await self._session.close()

    async def _ask(
        self,
        method: str,
        where: HostPort,
        path: str,
        token: str = "",
        body: Mapping[str, Any] | None = None,
        within: float = WITHIN,
    ) -> str:
        """The body of the answer, if that is HTTP 200."""
        if self._session is None:
            self._session = aiohttp.ClientSession()
        limits = aiohttp.ClientTimeout(total=within, sock_connect=WITHIN)
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        url = f"http://{where}{path}"
        try:
            async with self._session.request(
                method, url, json=body, headers=headers, timeout=limits
            ) as reply:
                text = await reply.text()
                if reply.status == 200:
                    return text
                message = f"{method} {url} answers HTTP {reply.status}: {text.strip()[:200]}"
                raise ProxyError(message, status=reply.status)
        except TimeoutError:
            raise ProxyError(f"{where} does not answer", away=True) from None
        except (OSError, aiohttp.ClientError) as error:
            raise _no_answer(where, error) from None


def _read(text: str, where: HostPort) -> Json:
    try:
        return msgspec.json.decode(text, type=Json)
    except msgspec.DecodeError:
        raise _no_rosproxy(where) from None


def _no_rosproxy(where: HostPort) -> ProxyError:
    return ProxyError(f"{where} does not answer as a rosproxy does")


def _no_answer(where: HostPort, error: Exception) -> ProxyError:
    number = error.errno if isinstance(error, OSError) else None
    if number == errno.ECONNREFUSED:
        return ProxyError(f"{where} refuses connections")
    reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return ProxyError(f"{where} can't be reached ({reason})", away=number is not None)
