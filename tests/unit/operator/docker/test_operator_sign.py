"""All operators of this machine are found, at any address."""

from contextlib import ExitStack, closing

import pytest

from rosproxy.shared.addresses import HostPort
from rosproxy_operator.docker.operator_sign import MOST_ENDPOINTS_ASKED, operators, publish_sign

ENGINE = "unix:///test.sock"
DEFAULT = HostPort("127.0.0.1", 11313)


def test_the_default_first_and_then_who_says_so_while_it_runs() -> None:
    other = HostPort("127.0.0.1", 61313)
    sign = publish_sign(other, ENGINE)
    assert sign
    with closing(sign):
        assert operators(DEFAULT, ENGINE) == [DEFAULT, other]
        assert operators(other, ENGINE) == [other]
        assert operators(DEFAULT, "tcp://another:2375") == [DEFAULT]
    assert operators(DEFAULT, ENGINE) == [DEFAULT]


@pytest.mark.parametrize("host", ["192.0.2.1", "ask.me.example", "[::ffff:192.0.2.1]"])
def test_nobody_is_asked_who_is_not_on_this_machine(host: str) -> None:
    sign = publish_sign(HostPort(host, 61313), ENGINE)
    assert sign
    with closing(sign):
        assert operators(DEFAULT, ENGINE) == [DEFAULT]


def test_of_many_signs_some_are_asked() -> None:
    with ExitStack() as stack:
        for number in range(2 * MOST_ENDPOINTS_ASKED):
            sign = publish_sign(HostPort("0.0.0.0", 61400 + number), ENGINE)
            assert sign
            stack.enter_context(closing(sign))
        assert len(operators(DEFAULT, ENGINE)) == MOST_ENDPOINTS_ASKED
