"""The routers for rmw_zenoh in ``rosproxy status``."""

from rosproxy.admin.status_document import (
    ProxyStatus,
    StatusSettings,
    ZenohLinkStatus,
    ZenohNodeStatus,
    ZenohSessionStatus,
    ZenohStatus,
)
from rosproxy.cli.status_table import render

STATUS = ProxyStatus(
    version="0.1.0",
    settings=StatusSettings(ros=("zenoh",)),
    zenoh=ZenohStatus(
        ports="7448-7467",
        listen=7447,
        restarts=1,
        links=(
            ZenohLinkStatus("robot:7447", True, "", 75.0),
            ZenohLinkStatus("lab:7447", False, "refused", 12.0),
        ),
        sessions=(
            ZenohSessionStatus(7448, "peer", "ab", "172.18.0.2:7448", "172.18.0.3:50000"),
            ZenohSessionStatus(None, "router", "cd", "172.18.0.2:40000", "192.0.2.7:7447"),
            ZenohSessionStatus(None, "client", "ef", "172.18.0.2:7447", "192.0.2.9:50000"),
        ),
        nodes=(
            ZenohNodeStatus("/talker\x1b[2J", 0, "172.18.0.3", ("/chatter",), (), ("/add",)),
            ZenohNodeStatus("/driver", 0, "", (), ("/cmd_vel",), (), 3),
        ),
    ),
)
SHOWN = """\
rosproxy 0.1.0, pid 0, up 0.0 s
left out 3 names and entries: /status is bounded, see docs/reference/limits.md

    zenoh routers run, ended 1 time; ports 7448-7467 for containers; port 7447 for outside; links to
    outside: robot:7447 up for 1 min, lab:7447 DOWN (refused) for 12 s
REMOTE            MODE    LOCAL             ROUTER
172.18.0.3:50000  peer    172.18.0.2:7448   port 7448
192.0.2.7:7447    router  172.18.0.2:40000  hub
192.0.2.9:50000   client  172.18.0.2:7447   port 7447
NODE            DOMAIN  ADDRESS     PUB  SUB  SRV
/talker\\x1b[2J  0       172.18.0.3    1    0    1
    publishes  /chatter
    services   /add
/driver         0       outside       0    1    0
    subscribes /cmd_vel
    not shown  3 names"""


def test_the_routers() -> None:
    assert render(STATUS, 100) == SHOWN


def test_proxies_on_other_hosts_stand_apart() -> None:
    hub = ZenohLinkStatus("node2:7447", False, "unresolvable", 3.0, hub=True)
    zenoh = ZenohStatus(ports="7448-7448", links=(hub,), hub_listen=7447)
    shown = render(ProxyStatus(settings=StatusSettings(ros=("zenoh",)), zenoh=zenoh), 200)
    assert "; port 7447 for proxies on other hosts; links to outside: none; " in shown
    assert "links to outside: none; proxies on other hosts: node2:7447 DOWN (unresolvable)" in shown


def test_links_to_other_sites_have_their_protocol() -> None:
    links = (ZenohLinkStatus("cloud:7447", True, since=3.0, protocol="tls"),)
    session = ZenohSessionStatus(
        None, "router", "ab", "172.18.0.2:40000", "192.0.2.9:7447", link=True
    )
    zenoh = ZenohStatus(
        ports="7448-7448", links=links, link_listen="quic/7449", sessions=(session,)
    )
    shown = render(ProxyStatus(settings=StatusSettings(ros=("zenoh",)), zenoh=zenoh), 200)
    assert "\n192.0.2.9:7447  router  172.18.0.2:40000  link" in shown
    assert "; port quic/7449 for other sites; links to outside: tls/cloud:7447 up for" in shown
