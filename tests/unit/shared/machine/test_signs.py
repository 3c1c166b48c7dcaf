"""The signs by which proxies of the same machine find each other."""

from contextlib import ExitStack, closing

from rosproxy.net.proxy_signs import MOST_SIGNS, Sign, overlapping_proxies, publish_sign
from rosproxy.shared.addresses import HostPort


def test_a_sign_is_read_while_it_stands_and_where_the_ports_overlap() -> None:
    own_admin = HostPort("127.0.0.1", 61312)
    other_admin = HostPort("::1", 61313)
    sign = publish_sign(("2", "1"), 61000, 61009, own_admin)
    assert sign
    with closing(sign):
        assert overlapping_proxies("1", 61009, 61020, other_admin) == [
            Sign("12", 61000, 61009, "127.0.0.1:61312")
        ]
        assert overlapping_proxies("2", 60990, 61000, other_admin)
        assert overlapping_proxies("1", 61010, 61020, other_admin) == []
        assert overlapping_proxies("1", 61000, 61009, own_admin) == [], "its own"
        own = publish_sign(("1",), 61000, 61009, other_admin)
        assert own
        with closing(own):
            assert [proxy.admin for proxy in overlapping_proxies("1", 61000, 61009, own_admin)] == [
                "[::1]:61313"
            ]
            assert len(overlapping_proxies("2", 61000, 61009, HostPort("h", 1))) == 1
    assert overlapping_proxies("1", 61000, 61009, other_admin) == []


def test_whoever_puts_up_many_signs_is_not_told_at_length() -> None:
    with ExitStack() as stack:
        for number in range(MOST_SIGNS + 3):
            for host in ("127.0.0.1", "ask.me.example"):
                sign = publish_sign(("1",), 61100, 61109, HostPort(host, 61400 + number))
                assert sign
                stack.enter_context(closing(sign))
        proxies = overlapping_proxies("1", 61100, 61109, HostPort("127.0.0.1", 1))
        assert len(proxies) == MOST_SIGNS
        assert {proxy.admin.partition(":")[0] for proxy in proxies} == {"127.0.0.1"}
