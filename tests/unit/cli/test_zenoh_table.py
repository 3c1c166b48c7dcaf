"""The routers for rmw_zenoh in ``rosproxy status``."""

from msgspec.structs import replace

from rosproxy.cli.status_table import render
from rosproxy.cli.zenoh_table import MOST_NAMES, MOST_TYPE_COLUMNS, zenoh_lines
from rosproxy.shared.documents.status_document import (
    NamedTypeStatus,
    ProxyStatus,
    StatusSettings,
    ZenohLinkStatus,
    ZenohNodeStatus,
    ZenohQosStatus,
    ZenohSessionStatus,
    ZenohStatus,
)

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
    not shown  3 names
TOPIC     DOMAIN  TYPE  PUB  SUB
/chatter  0               1    0
/cmd_vel  0               0    1
SERVICE  DOMAIN  TYPE  SRV  CLI
/add     0               1    0"""


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


STRING = "std_msgs/msg/String"
SMALL = ZenohQosStatus("/chatter", "publisher", "RELIABLE", "VOLATILE", "KEEP_LAST", 10)
TALKER = ZenohNodeStatus(
    *("/talker", 0, "172.18.0.3", ("/chatter",)),
    services=("/add", "/talker/get_parameters"),
    types=(
        NamedTypeStatus("/add", "example_interfaces/srv/AddTwoInts"),
        NamedTypeStatus("/chatter", STRING),
    ),
    qos=(SMALL,),
)
LISTENER = ZenohNodeStatus(
    *("/listener", 0, "172.18.0.4", (), ("/chatter",)),
    services=("/listener/get_parameters",),
    calls=("/add", "/talker/get_parameters"),
    types=(NamedTypeStatus("/chatter", STRING),),
    qos=(ZenohQosStatus("/chatter", "subscription", "BEST_EFFORT", "VOLATILE", "KEEP_ALL"),),
)
NAMES = """\
    services   /listener/get_parameters
    calls      /add  /talker/get_parameters
TOPIC     DOMAIN  TYPE                 PUB  SUB
/chatter  0       std_msgs/msg/String    1    1
    PUB        RELIABLE VOLATILE KEEP_LAST(10)
    SUB        BEST_EFFORT VOLATILE KEEP_ALL
SERVICE                 DOMAIN  TYPE                               SRV  CLI
/add                    0       example_interfaces/srv/AddTwoInts    1    1
/talker/get_parameters  0                                            1    1
    not shown  1 service of parameters and types"""


def test_topics_have_types_and_qos_and_services_have_servers_and_clients() -> None:
    shown = "\n".join(zenoh_lines(ZenohStatus(nodes=(TALKER, LISTENER)), 100))
    assert shown.endswith(NAMES)


def test_the_same_qos_of_both_sides_is_one_line() -> None:
    alike = replace(LISTENER, qos=(replace(SMALL, kind="subscription"),), calls=(), services=())
    shown = [*zenoh_lines(ZenohStatus(nodes=(TALKER, alike)), 100)]
    assert "    QoS        RELIABLE VOLATILE KEEP_LAST(10)" in shown
    assert not [line for line in shown if line.startswith("    PUB")]


def test_domains_are_apart() -> None:
    far = replace(LISTENER, domain=7)
    shown = [*zenoh_lines(ZenohStatus(nodes=(TALKER, far)), 100)]
    rows = [line.split() for line in shown if line.startswith("/chatter")]
    assert rows == [["/chatter", "0", STRING, "1", "0"], ["/chatter", "7", STRING, "0", "1"]]


def test_the_tables_of_names_are_bounded() -> None:
    many = tuple(f"/t{number:04}" for number in range(MOST_NAMES + 7))
    types = (NamedTypeStatus("/t0000", "x" * 500),)
    qos = tuple(replace(SMALL, name="/t0000", depth=depth) for depth in range(5))
    node = ZenohNodeStatus("/crowd\x1b", 0, "", many, (), many, types=types, qos=qos)
    shown = [*zenoh_lines(ZenohStatus(nodes=(node,)), 100)]
    rows = [line for line in shown if line.startswith("/t")]
    assert len(rows) == 2 * MOST_NAMES
    assert "x" * MOST_TYPE_COLUMNS not in rows[0]
    assert shown[-1] == "    not shown  7 services"
    assert "    not shown  7 topics" in shown
    assert any("KEEP_LAST(2) and 2 more" in line for line in shown)


def test_names_of_types_and_qos_are_harmless() -> None:
    bad = "\x1b[2J"
    node = ZenohNodeStatus(
        *("/n", 0, "", (bad,)),
        types=(NamedTypeStatus(bad, bad),),
        qos=(ZenohQosStatus(bad, "publisher", bad, bad, bad),),
    )
    assert "\x1b" not in "\n".join(zenoh_lines(ZenohStatus(nodes=(node,)), 100))
