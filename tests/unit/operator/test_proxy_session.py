"""A proxy's confirmation counts only for the process that confirmed."""

import asyncio
from collections.abc import Collection, Mapping, Sequence

import pytest

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.policy.layers import PolicyLayer
from rosproxy_operator.common.proxy_client import ProxyClient, ProxyError
from rosproxy_operator.common.proxy_session import AllowedCallers, ProxySession

ADMIN = HostPort("172.30.0.2", 11312)
CALLERS = AllowedCallers(("172.18.0.5",))


class SlowClient(ProxyClient):
    """A client whose proxy answers once ``answers`` is set, perhaps with ``error``."""

    def __init__(self) -> None:
        super().__init__()
        self.answers = asyncio.Event()
        self.asked = asyncio.Event()
        self.error: ProxyError | None = None
        self.calls = 0

    async def _answer(self) -> None:
        self.calls += 1
        self.asked.set()
        await self.answers.wait()
        if self.error:
            raise self.error

    async def send_policy(self, admin: HostPort, token: str, layers: Sequence[PolicyLayer]) -> None:
        await self._answer()

    async def send_selected(
        self,
        admin: HostPort,
        token: str,
        addresses: Collection[str],
        peers: Collection[str] | None = None,
        former: Mapping[str, Sequence[int]] | None = None,
    ) -> None:
        await self._answer()


async def test_what_was_confirmed_is_known_until_forgotten() -> None:
    client = SlowClient()
    client.answers.set()
    session = ProxySession(client, ADMIN, "token")
    await session.send_policy(())
    await session.send_callers(CALLERS)
    assert session.has_policy(())
    assert session.has_callers(CALLERS)
    session.forget()
    assert not session.has_policy(())
    assert not session.has_callers(CALLERS)


async def test_what_was_refused_is_not_known() -> None:
    client = SlowClient()
    client.answers.set()
    client.error = ProxyError("refuses")
    session = ProxySession(client, ADMIN, "token")
    with pytest.raises(ProxyError, match="refuses"):
        await session.send_policy(())
    assert not session.has_policy(())


async def test_two_that_want_the_policy_told_tell_it_once() -> None:
    client = SlowClient()
    session = ProxySession(client, ADMIN, "token")
    telling = [asyncio.create_task(session.send_policy(())) for _ in range(2)]
    await client.asked.wait()
    client.answers.set()
    await asyncio.gather(*telling)
    assert client.calls == 1


async def test_a_process_that_came_meanwhile_has_confirmed_nothing() -> None:
    """The answer may come from the former process."""
    client = SlowClient()
    session = ProxySession(client, ADMIN, "token")
    telling = [
        asyncio.create_task(session.send_policy(())),
        asyncio.create_task(session.send_callers(CALLERS)),
    ]
    await client.asked.wait()
    session.forget()
    client.answers.set()
    await asyncio.gather(*telling)
    assert not session.has_policy(())
    assert not session.has_callers(CALLERS)
