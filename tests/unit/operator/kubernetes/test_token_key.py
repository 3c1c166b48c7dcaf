"""The key of the proxies' tokens: made once, kept, and made again after a deletion."""

import base64
from typing import Any

import pytest

from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.kubernetes.api.api_client import Api, ApiUnavailable
from rosproxy_operator.kubernetes.proxies.token_key import KEY_BYTES, TokenKey
from rosproxy_operator.kubernetes.resources.model import Name
from tests.unit.operator.kubernetes.api_server import ApiServer

SECRET = Name("ns", "key")


async def read(key: TokenKey) -> bytes:
    return await in_thread(key.read)


def put(server: ApiServer, data: dict[str, str] | None = None) -> None:
    body: dict[str, Any] = {"metadata": {"name": "key"}}
    server.put("secrets", {**body, **({"data": data} if data else {})})


def stored_key(server: ApiServer) -> bytes:
    return base64.b64decode(server.get("secrets", "key")["data"]["key"])


async def test_it_is_made_once(server: ApiServer, api: Api) -> None:
    put(server)
    key = await read(TokenKey(api, SECRET))
    assert len(key) == KEY_BYTES
    assert stored_key(server) == key
    assert await read(TokenKey(api, SECRET)) == key
    assert len(server.asked("PATCH", "secrets")) == 1


@pytest.mark.parametrize("stored", ["", "????", base64.b64encode(b"short").decode()])
async def test_what_is_no_key_is_replaced(server: ApiServer, api: Api, stored: str) -> None:
    put(server, {"key": stored, "other": "eA=="})
    key = await read(TokenKey(api, SECRET))
    assert stored_key(server) == key
    assert server.get("secrets", "key")["data"]["other"] == "eA=="


async def test_a_key_that_was_taken_away_is_replaced_by_another(
    server: ApiServer, api: Api
) -> None:
    put(server)
    token_key = TokenKey(api, SECRET)
    first = await read(token_key)
    put(server)
    assert await read(token_key) != first
    assert stored_key(server) == await read(token_key)


@pytest.mark.parametrize("status", [403, 404])
async def test_without_its_secret_it_lasts_as_long_as_the_operator(
    server: ApiServer, api: Api, status: int
) -> None:
    put(server)
    token_key = TokenKey(api, SECRET)
    key = await read(token_key)
    assert not token_key.problems
    server.refuse("GET", "secrets", status, "no")
    assert await read(token_key) == key
    text = "".join(problem.message for problem in token_key.problems)
    assert text.count("Secret ns/key") == 1
    assert ("Create an empty Secret" in text) == (status == 404)
    server.refusals.clear()
    assert await read(token_key) == key
    assert not token_key.problems


async def test_without_any_secret_it_is_the_processs_own(api: Api) -> None:
    token_key = TokenKey(api, None)
    key = await read(token_key)
    assert await read(token_key) == key
    assert await read(TokenKey(api, None)) != key


async def test_an_api_server_that_is_away_makes_no_other_key(server: ApiServer, api: Api) -> None:
    put(server)
    server.refuse("GET", "secrets", 503, "starting")
    with pytest.raises(ApiUnavailable):
        await read(TokenKey(api, SECRET))


async def test_whoever_was_faster_has_the_right_one(
    server: ApiServer, api: Api, monkeypatch: pytest.MonkeyPatch
) -> None:
    put(server)
    slower = TokenKey(api, SECRET)
    faster = TokenKey(api, SECRET)
    real = api.get

    def get(*words: Any) -> dict[str, Any]:
        secret = real(*words)
        monkeypatch.setattr(api, "get", real)
        faster.read()
        return secret

    monkeypatch.setattr(api, "get", get)
    with pytest.raises(ApiUnavailable):
        await read(slower)
    assert await read(slower) == await read(faster)
