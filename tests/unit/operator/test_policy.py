"""The administrator's policy, and the delivery to a proxy."""

import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest
from aiohttp import web
from aiohttp.test_utils import TestServer
from msgspec import structs

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.policy.layers import PolicyLayer, PolicyMode, layers_as_json, read_layers
from rosproxy.shared.policy.rules import parse_rules
from rosproxy.shared.setting_kinds import SettingError
from rosproxy_operator.common.policy import (
    LONGEST_POLICY_BYTES,
    MOST_RULES_OF_AUTHOR,
    administrators_policy,
    as_variable,
)
from rosproxy_operator.common.proxy_client import PolicyRefused, ProxyClient, ProxyError

RULES = parse_rules("deny publish /camera/*; deny slave shutdown by /a?")
OWN = PolicyLayer("label of container a", RULES, addresses=frozenset({"172.18.0.5"}))


def test_the_options_make_one_layer_or_none() -> None:
    assert administrators_policy([], "audit") == ()
    assert administrators_policy([()], "audit") == ()
    (layer,) = administrators_policy([RULES, parse_rules("allow call *")], "audit")
    assert (layer.name, layer.mode) == ("administrator", PolicyMode.AUDIT)
    assert list(map(str, layer.rules)) == [*map(str, RULES), "allow call *"]
    assert layer.addresses is None


@pytest.mark.parametrize(
    ("count", "glob", "told"),
    [
        (MOST_RULES_OF_AUTHOR, "/a", ""),
        (MOST_RULES_OF_AUTHOR + 1, "/a", "501 rules, at most 500 are accepted"),
        (200, "/" + "a" * 255, f"at most {LONGEST_POLICY_BYTES} are accepted"),
        (400, "/" + "a" * 255, f"at most {LONGEST_POLICY_BYTES} are accepted"),  # over the variable
    ],
)
def test_a_policy_is_bounded(count: int, glob: str, told: str) -> None:
    """Linux starts no program with too long variables."""
    rules = [parse_rules(f"deny publish {glob}")] * count
    if not told:
        assert administrators_policy(rules, "enforce")
        return
    with pytest.raises(SettingError, match=told) as error:
        administrators_policy(rules, "enforce")
    assert error.value.option == "--policy"


def test_at_its_creation_a_proxy_gets_what_fits_into_a_variable() -> None:
    common = administrators_policy([RULES], "enforce")
    assert read_layers(json.loads(as_variable([*common, OWN]))) == (*common, OWN)
    assert as_variable([]) == ""


def test_a_proxy_denies_more_if_its_policy_is_too_long_for_a_variable() -> None:
    common = administrators_policy([RULES], "enforce")
    long = structs.replace(OWN, rules=parse_rules("deny publish /" + "a" * 255) * 400)
    *kept, stricter = read_layers(json.loads(as_variable([*common, long])))
    assert tuple(kept) == common
    assert stricter.rules == parse_rules("deny publish *")
    assert stricter.addresses == OWN.addresses
    for_all = structs.replace(long, addresses=None)
    (stricter,) = read_layers(json.loads(as_variable([*common, for_all])))
    assert stricter.rules == parse_rules("deny publish *; deny slave *")
    assert stricter.addresses is None


def test_a_long_policy_that_denies_nothing_becomes_empty_in_the_variable() -> None:
    allowing = structs.replace(OWN, rules=parse_rules("allow publish /" + "a" * 255) * 400)
    audited = structs.replace(
        OWN, rules=parse_rules("deny call /" + "a" * 255) * 400, mode=PolicyMode.AUDIT
    )
    assert read_layers(json.loads(as_variable([allowing, audited]))) == ()


class Answers:
    """A proxy's admin endpoint with given answers, which notes all requests."""

    def __init__(self) -> None:
        self.status = 200
        self.text = "{}"
        self.told: list[Any] = []

    async def policy(self, request: web.Request) -> web.Response:
        self.told.append((request.headers.get("Authorization"), await request.json()))
        return web.Response(status=self.status, text=self.text)


@asynccontextmanager
async def proxy(*routes: web.RouteDef) -> AsyncIterator[tuple[ProxyClient, HostPort]]:
    application = web.Application()
    application.router.add_routes(routes)
    client = ProxyClient()
    async with TestServer(application, host="127.0.0.1") as server:
        yield client, HostPort("127.0.0.1", server.port or 0)
        await client.close()


async def test_a_proxy_is_told_all_layers() -> None:
    answers = Answers()
    async with proxy(web.post("/policy", answers.policy)) as (client, admin):
        await client.send_policy(admin, "token", [OWN])
    assert answers.told == [("Bearer token", {"layers": layers_as_json([OWN])})]


async def test_a_proxy_of_a_former_release_has_no_policy_at_all() -> None:
    async with proxy() as (client, admin):
        await client.send_policy(admin, "token", [])
        with pytest.raises(PolicyRefused, match="its image is of a former release"):
            await client.send_policy(admin, "token", [OWN])


async def test_it_is_in_force_before_the_master_has_heard() -> None:
    answers = Answers()
    answers.status = 503
    async with proxy(web.post("/policy", answers.policy)) as (client, admin):
        await client.send_policy(admin, "token", [OWN])
    assert len(answers.told) == 1


@pytest.mark.parametrize(("status", "kind"), [(400, PolicyRefused), (403, ProxyError)])
async def test_one_that_does_not_take_it(status: int, kind: type[ProxyError]) -> None:
    answers = Answers()
    answers.status = status
    answers.text = "layer 'x': too long"
    async with proxy(web.post("/policy", answers.policy)) as (client, admin):
        with pytest.raises(ProxyError, match="layer 'x': too long") as error:
            await client.send_policy(admin, "token", [OWN])
    assert type(error.value) is kind
    assert error.value.status == status
