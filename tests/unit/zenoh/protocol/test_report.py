"""Reports of the router process: content, and no error but ValueError."""

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.shared.addresses import HostPort
from rosproxy.zenoh.protocol.report import (
    Ends,
    Report,
    RouterSession,
    SessionConnection,
    ends_of,
    read_report,
)

ADMIN_SPACE = b"""{"routers": [{"zid": "e5e8", "locators": ["tcp/127.0.0.1:7448"], "sessions": [
  {"links": [{"dst": "tcp/172.18.0.3:60546", "src": "tcp/172.18.0.2:7448"}], "peer": "86c4",
   "shm": true, "weight": null, "whatami": "peer"}], "version": "v1.7.2"}]}"""
"""A report of a router of zenoh 1.7.2."""


def test_what_a_router_says_of_itself_is_read() -> None:
    (router,) = read_report(ADMIN_SPACE).routers
    (session,) = router.sessions
    assert (router.zid, session.peer, session.whatami) == ("e5e8", "86c4", "peer")
    assert ends_of(session) == Ends(HostPort("172.18.0.2", 7448), HostPort("172.18.0.3", 60546))


def test_a_report_without_changes_of_the_graph_has_no_tokens() -> None:
    assert read_report(b'{"routers": [], "tokens": null}').tokens is None
    assert read_report(b'{"tokens": ["a", "b"], "tokens_left_out": 3}') == Report((), ("a", "b"), 3)
    assert read_report(b'{"error": "no router"}').error == "no router"


@pytest.mark.parametrize("locator", ["unixpipe/x", "tcp/", "tcp/1.2.3.4", "tcp/1.2.3.4:0", "x"])
def test_a_session_without_a_link_of_tcp_has_no_ends(locator: str) -> None:
    assert ends_of(RouterSession("a", "peer", (SessionConnection(locator, locator),))) is None


def test_an_address_of_ipv4_is_plain() -> None:
    link = SessionConnection("tcp/[::ffff:172.18.0.2]:7448", "tcp/[::ffff:172.18.0.3]:5")
    ends = Ends(HostPort("172.18.0.2", 7448), HostPort("172.18.0.3", 5))
    assert ends_of(RouterSession("a", "peer", (link,))) == ends


def test_what_follows_an_address_does_not_count() -> None:
    link = SessionConnection("tcp/1.2.3.4:5?prio=1-7", "tcp/1.2.3.5:6#iface=eth0")
    ends = Ends(HostPort("1.2.3.4", 5), HostPort("1.2.3.5", 6))
    assert ends_of(RouterSession("a", "peer", (link,))) == ends


@given(
    st.one_of(st.binary(), st.recursive(st.none() | st.text(), st.lists).map(msgspec.json.encode))
)
def test_anything_else_is_a_value_error(line: bytes) -> None:
    with pytest.raises(ValueError, match=r"not valid"):
        read_report(line)
