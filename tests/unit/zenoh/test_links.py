"""The state of the hub's links."""

import pytest

from rosproxy.net.addresses import HostPort
from rosproxy.zenoh.links import Link, LinkFault, is_linked
from rosproxy.zenoh.protocol.report import Ends

PEER = HostPort("robot", 7447)
ADDRESSES = ("192.0.2.7", "fd00::7")


@pytest.mark.parametrize(
    ("local", "remote", "listen", "expected"),
    [
        (HostPort("172.18.0.2", 40000), HostPort("192.0.2.7", 7447), None, True),
        (HostPort("fd00::2", 40000), HostPort("fd00::7", 7447), None, True),
        (HostPort("172.18.0.2", 40000), HostPort("192.0.2.8", 7447), None, False),
        # Another router of the same machine.
        (HostPort("172.18.0.2", 40000), HostPort("192.0.2.7", 7448), None, False),
        # The peer has dialed the hub.
        (HostPort("172.18.0.2", 7447), HostPort("192.0.2.7", 50000), 7447, True),
    ],
)
def test_a_link_is_a_session_with_the_peer(
    local: HostPort, remote: HostPort, listen: int | None, expected: bool
) -> None:
    assert is_linked(PEER, ADDRESSES, [Ends(local, remote)], listen) is expected
    assert not is_linked(PEER, (), [Ends(local, remote)], listen)


def test_two_routers_that_dial_each_other_have_two_connections() -> None:
    """Behind NAT, only the connection that the hub itself has opened shows the peer's address."""
    ends = [
        Ends(HostPort("10.244.0.2", 7447), HostPort("10.88.0.12", 50000)),
        Ends(HostPort("10.244.0.2", 50001), HostPort("192.0.2.7", 7447)),
    ]
    assert is_linked(PEER, ADDRESSES, ends, 7447)
    assert not is_linked(PEER, ADDRESSES, ends[:1], 7447)


def test_a_link_knows_since_when_it_is_up_or_down() -> None:
    link = Link(PEER, 1.0)
    assert link.note(LinkFault.REFUSED, 2.0)
    assert not link.note(LinkFault.REFUSED, 3.0)
    assert link.note(LinkFault.SILENT, 4.0)
    assert link.since == 1.0
    assert link.note(None, 5.0)
    assert (link.fault, link.since) == (None, 5.0)
    assert link.note(LinkFault.REFUSED, 6.0)
    assert link.since == 6.0
