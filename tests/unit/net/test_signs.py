"""The signs by which proxies of one machine know each other."""

from contextlib import ExitStack, closing

from rosproxy.net.addresses import HostPort
from rosproxy.net.signs import MOST, Sign, overlapping_proxies, publish_sign


def test_a_sign_is_read_while_it_stands_and_where_the_ports_overlap() -> None:
    one, two = HostPort("127.0.0.1", 61312), HostPort("::1", 61313)
    sign = publish_sign(("2", "1"), 61000, 61009, one)
    assert sign
    with closing(sign):
        assert overlapping_proxies("1", 61009, 61020, two) == [
            Sign("12", 61000, 61009, "127.0.0.1:61312")
        ]
        assert overlapping_proxies("2", 60990, 61000, two)
        assert overlapping_proxies("1", 61010, 61020, two) == []
        assert overlapping_proxies("1", 61000, 61009, one) == [], "its own"
        own = publish_sign(("1",), 61000, 61009, two)
        assert own
        with closing(own):
            assert [each.admin for each in overlapping_proxies("1", 61000, 61009, one)] == [
                "[::1]:61313"
            ]
            assert len(overlapping_proxies("2", 61000, 61009, HostPort("h", 1))) == 1
    assert overlapping_proxies("1", 61000, 61009, two) == []


def test_whoever_puts_up_many_signs_is_not_told_at_length() -> None:
    with ExitStack() as stack:
        for number in range(MOST + 3):
            for host in ("127.0.0.1", "ask.me.example"):
                sign = publish_sign(("1",), 61100, 61109, HostPort(host, 61400 + number))
                assert sign
                stack.enter_context(closing(sign))
        found = overlapping_proxies("1", 61100, 61109, HostPort("127.0.0.1", 1))
        assert len(found) == MOST
        assert {each.admin.partition(":")[0] for each in found} == {"127.0.0.1"}
