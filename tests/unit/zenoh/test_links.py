"""The state of the hub's links."""

import pytest

from rosproxy.shared.addresses import HostPort
from rosproxy.zenoh.links import (
    Link,
    LinkFault,
    alert_fault,
    is_linked,
    left_behind,
    own_peers,
    verify_fault,
)
from rosproxy.zenoh.protocol.report import Ends, RouterReport, RouterSession, SessionConnection

PEER = HostPort("robot", 7447)
ADDRESSES = ("192.0.2.7", "fd00::7")


@pytest.mark.parametrize(
    ("local", "remote", "listen", "expected"),
    [
        (HostPort("172.18.0.2", 40000), HostPort("192.0.2.7", 7447), 7449, True),
        (HostPort("fd00::2", 40000), HostPort("fd00::7", 7447), 7449, True),
        (HostPort("172.18.0.2", 40000), HostPort("192.0.2.8", 7447), 7449, False),
        # Another router of the same machine.
        (HostPort("172.18.0.2", 40000), HostPort("192.0.2.7", 7448), 7449, False),
        # The peer has dialed the hub.
        (HostPort("172.18.0.2", 7447), HostPort("192.0.2.7", 50000), 7447, True),
    ],
)
def test_a_link_is_a_session_with_the_peer(
    local: HostPort, remote: HostPort, listen: int, expected: bool
) -> None:
    assert is_linked(PEER, ADDRESSES, [Ends(local, remote)], [listen]) is expected
    assert not is_linked(PEER, (), [Ends(local, remote)], [listen])


def test_two_routers_that_dial_each_other_have_two_connections() -> None:
    """Behind NAT, only the connection that the hub itself has opened shows the peer's address."""
    ends = [
        Ends(HostPort("10.244.0.2", 7447), HostPort("10.88.0.12", 50000)),
        Ends(HostPort("10.244.0.2", 50001), HostPort("192.0.2.7", 7447)),
    ]
    assert is_linked(PEER, ADDRESSES, ends, [7447])
    assert not is_linked(PEER, ADDRESSES, ends[:1], [7447])


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


def test_a_link_leaves_addresses_that_its_host_name_has_no_more() -> None:
    moved = Link(PEER, 1.0, addresses=ADDRESSES, fault=None)
    other = Link(HostPort("other", 7447), 1.0, addresses=("192.0.2.9",), fault=None)
    local = HostPort("172.18.0.2", 40000)
    remotes = [HostPort(*ADDRESSES[:1], 7447), HostPort("192.0.2.7", 7448)]
    routers = [Ends(local, remote) for remote in remotes]
    moved.note_addresses(())
    moved.note_addresses(ADDRESSES[1:])
    moved.note_addresses(ADDRESSES)
    assert left_behind(moved, [moved, other], routers) == set()
    moved.note_addresses(("192.0.2.8",))
    assert left_behind(moved, [moved, other], routers) == {remotes[0]}
    assert left_behind(other, [moved, other], routers) == set()
    other.addresses = ADDRESSES
    assert left_behind(moved, [moved, other], routers) == set()
    other.addresses = ("192.0.2.9",)
    moved.note(LinkFault.MOVED, 2.0)
    assert left_behind(moved, [moved, other], routers) == {remotes[0]}
    moved.note(None, 3.0)
    assert left_behind(moved, [moved, other], routers) == set()


def test_zenoh_reports_the_dialed_name_of_a_link_over_quic() -> None:
    ends = Ends(HostPort("0.0.0.0", 40000), HostPort("robot", 7447))
    assert is_linked(PEER, (), [ends], ())
    link = Link(PEER, 1.0, protocol="quic")
    assert str(link) == "quic/robot:7447"
    assert str(Link(PEER, 1.0)) == "robot:7447"


@pytest.mark.parametrize(
    ("reason", "fault"),
    [
        ("SSLV3_ALERT_CERTIFICATE_EXPIRED", LinkFault.OWN_EXPIRED),
        ("TLSV1_ALERT_UNKNOWN_CA", LinkFault.OWN_FOREIGN),
        ("TLSV1_ALERT_DECRYPT_ERROR", LinkFault.OWN_FOREIGN),
        ("SSLV3_ALERT_BAD_CERTIFICATE", LinkFault.OWN_REFUSED),
        ("TLSV13_ALERT_CERTIFICATE_REQUIRED", LinkFault.OWN_REFUSED),
        ("TLSV1_ALERT_INTERNAL_ERROR", LinkFault.NO_SESSION),
    ],
)
def test_alerts_of_tls_tell_why_a_peer_refuses_the_certificate(
    reason: str, fault: LinkFault
) -> None:
    assert alert_fault(reason) is fault


def test_an_unknown_result_of_a_check_is_a_fault_of_the_certificate() -> None:
    assert verify_fault(26) is LinkFault.PEER_INVALID


@pytest.mark.parametrize(
    ("zid", "dst", "expected"),
    [
        ("01", "tcp/192.0.2.7:7447", {PEER}),
        ("01", "tcp/10.96.0.9:7447", {PEER}),  # zenoh has found another address
        ("01", "tcp/192.0.2.7:7448", set()),
        ("01", "unixsock-stream//run/7448", set()),
        ("04", "tcp/192.0.2.7:7447", set()),  # a router outside
    ],
)
def test_a_peer_at_which_the_hub_reaches_a_router_of_the_proxy(
    zid: str, dst: str, expected: set[HostPort]
) -> None:
    links = [Link(PEER, 0.0, addresses=ADDRESSES), Link(HostPort("robot", 7450), 0.0)]
    # Other peers at this port stay: an address that zenoh did not reach, and a link that is up.
    links += [Link(HostPort("10.0.0.5", 7447), 0.0), Link(HostPort("up", 7447), 0.0, fault=None)]
    session = RouterSession(zid, "router", (SessionConnection("tcp/172.18.0.2:5", dst),))
    assert own_peers(links, [RouterReport("01"), RouterReport("02", (session,))]) == expected
    assert not own_peers(links, [])
