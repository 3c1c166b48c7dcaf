"""Visitors that may see the page."""

from typing import Any

from aiohttp.test_utils import make_mocked_request

from rosproxy.page.visitors import KEY_LIFETIME_S, MOST_TOKENS, SESSION_S, ExpiringTokens, Visitors
from rosproxy.shared.setting_kinds import hash_token

TOKEN = "a token of a test"


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def request(source: str = "192.0.2.9", host: str = "192.0.2.1:11312", **headers: str) -> Any:
    """A request from an address."""

    class Transport:
        def get_extra_info(self, name: str, default: object = None) -> object:
            return (source, 4000) if name == "peername" else default

        def is_closing(self) -> bool:
            return False

    return make_mocked_request("GET", "/", headers={"Host": host, **headers}, transport=Transport())


def test_without_a_token_whoever_gets_there_may_look() -> None:
    open_to_all = Visitors(None, Clock())
    assert open_to_all.may_look(request())
    assert not open_to_all.may_look(request(host="evil.example"))
    assert not open_to_all.may_look(request("127.0.0.1", "evil.example"))
    known = Visitors(None, Clock(), own_names={"robot.lab.example"})
    assert known.may_look(request(host="robot.lab.example:11312"))


def test_an_operators_page_is_for_loopback_alone() -> None:
    local = Visitors(None, Clock(), local=True)
    assert local.may_look(request("127.0.0.1", "localhost:11313"))
    assert local.may_look(request("::1", "localhost:11313"))
    assert not local.may_look(request())
    assert not local.may_look(request(Authorization="Bearer "))
    assert "loopback" in local.refusal


def test_with_a_token_others_than_loopback_must_know_it() -> None:
    guarded = Visitors(hash_token(TOKEN), Clock())
    assert guarded.may_look(request("127.0.0.1", "localhost:11312"))
    assert not guarded.may_look(request("127.0.0.1", "evil.example"))
    assert not guarded.may_look(request())
    assert not guarded.may_look(request(Authorization="Bearer wrong"))
    assert not guarded.may_look(request(Authorization=f"Basic {TOKEN}"))
    assert guarded.may_look(request(Authorization=f"Bearer {TOKEN}"))
    assert guarded.may_look(request(host="evil.example", Authorization=f"Bearer {TOKEN}"))


def test_a_cookie_lets_look_for_a_time_and_at_one_port() -> None:
    clock = Clock()
    guarded = Visitors(hash_token(TOKEN), clock)
    cookie = guarded.new_session()
    assert guarded.may_look(request(Cookie=f"rosproxy-11312={cookie}"))
    assert not guarded.may_look(request(Cookie=f"rosproxy-11313={cookie}"))
    assert not guarded.may_look(request(Cookie=f"rosproxy-11312={TOKEN}"))
    clock.now += SESSION_S + 1
    assert not guarded.may_look(request(Cookie=f"rosproxy-11312={cookie}"))


async def test_a_key_is_good_once_and_not_for_long() -> None:
    clock = Clock()
    guarded = Visitors(hash_token(TOKEN), clock)
    key = (await guarded.issue_key({}))["key"]
    assert guarded.use_key(key)
    assert not guarded.use_key(key)
    late = (await guarded.issue_key({}))["key"]
    clock.now += KEY_LIFETIME_S + 1
    assert not guarded.use_key(late)
    assert not guarded.use_key("")


def test_so_many_are_good_at_a_time_and_the_oldest_goes() -> None:
    passes = ExpiringTokens(10.0, Clock())
    issued = [passes.issue() for _ in range(MOST_TOKENS + 1)]
    assert [passes.is_valid(token) for token in issued] == [False] + [True] * MOST_TOKENS
