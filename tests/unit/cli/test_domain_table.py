"""Domains of ROS 2 in ``rosproxy status``."""

from msgspec.structs import replace

from rosproxy.cli.status_table import render
from rosproxy.shared.documents.status_document import (
    DataPlaneStatus,
    DomainStatus,
    LocatorStatus,
    NamedTypeStatus,
    ParticipantStatus,
    ProxyStatus,
    StatusSettings,
)

INSIDE = ParticipantStatus(
    guid_prefix="01.0f.aa",
    address="172.30.0.5",
    vendor="Fast DDS",
    leases=(
        LocatorStatus(11401, "172.30.0.5:7410", "metatraffic", 3, 1500, 500.0, "copy", "discovery"),
        LocatorStatus(
            11402, "172.30.0.5:7411", "data", plane="kernel", kernel_datagrams=7, kernel_bytes=900
        ),
        LocatorStatus(11403, "172.30.0.5:7000", "data", plane="copy", reason="no \x1broute"),
    ),
    publishes=("/chatter", "/evil\x1b[2J"),
    services=("/add",),
    nodes=("/talker", "/bad\x1b[2J"),
    types=(NamedTypeStatus("/chatter", "std_msgs/msg/String"),),
)
OUTSIDE = ParticipantStatus(
    guid_prefix="01.10.bb", address="10.0.0.9", vendor="Cyclone DDS", proven=False
)
DOMAIN = DomainStatus(
    domain=7,
    discovery="10.0.0.1:11400",
    lan_relay="172.30.0.1:7500",
    ports_used=1,
    ports_free=62,
    dropped=4,
    inside=(INSIDE,),
    outside=(OUTSIDE,),
)


def shown(domain: DomainStatus) -> str:
    settings = StatusSettings(ros=("2",), inside_networks=("172.30.0.0/16",))
    return render(ProxyStatus(settings=settings, domains=(domain,)), 120)


def test_who_has_nobody_to_send_to_is_not_in_doubt() -> None:
    assert "outside?" in shown(DOMAIN)
    alone = shown(replace(DOMAIN, inside=()))
    assert "outside" in alone
    assert "outside?" not in alone


def test_a_domain_and_its_participants_are_shown() -> None:
    text = shown(DOMAIN)
    for expected in (
        "ROS 2, domain 7, networks 172.30.0.0/16",
        "domain 7: LAN relay 172.30.0.1:7500; discovery at 10.0.0.1:11400; 1 ports used, 62 free",
        "4 datagrams refused",
        "11401 to 172.30.0.5:7410",
        "/chatter",
        "/add",
        "/chatter std_msgs/msg/String",
        "nodes      /talker",
        "2.4 kB  500 B/s",
        "outside?",
    ):
        assert expected in text, expected
    assert "\x1b" not in text
    assert "master" not in text


def test_what_the_kernel_forwards_is_told() -> None:
    by_kernel = DataPlaneStatus("auto", "kernel")
    text = shown(replace(DOMAIN, data_plane=by_kernel))
    assert "user data forwarded by the kernel" in " ".join(text.split())
    assert "7 datagrams, 900 B as IP packets, to 11402; 11403 not used: no " in text
    assert "2.4 kB" in text
    assert "\x1b" not in text
    by_proxy = DataPlaneStatus("auto", "copy", "no right")
    text = " ".join(shown(replace(DOMAIN, data_plane=by_proxy)).split())
    assert "user data relayed by the proxy (no right)" in text
    assert "not used" not in text


def test_who_is_told_nobody_is_told_so() -> None:
    text = shown(DomainStatus(domain=0))
    assert "so inside is announced to no host outside" in " ".join(text.split())
    assert "No participant has been heard yet." in text
