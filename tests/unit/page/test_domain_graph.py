"""The document of a proxy for ROS 2."""

from typing import Any

import pytest
from msgspec.structs import replace

from rosproxy.page.domain_graph import received
from rosproxy.page.graph_document import graph_document
from rosproxy.page.measures import Measures
from rosproxy.shared.documents.status_document import (
    DomainStatus,
    HiddenStatus,
    LocatorStatus,
    MismatchStatus,
    ParticipantStatus,
    PolicyStatus,
    ProxyStatus,
    StatusSettings,
)

DATA = LocatorStatus(11402, "172.30.0.5:7411", "data", rate=123.0, plane="kernel")
INSIDE = ParticipantStatus(
    "01.0f.aa",
    "172.30.0.5",
    "Fast DDS",
    (DATA,),
    subscribes=("/chatter", "/rosout", "ros_discovery_info"),
)
OUTSIDE = ParticipantStatus(
    "01.10.bb", "10.0.0.9", "Cyclone DDS", publishes=("/chatter", "/rosout", "ros_discovery_info")
)
LINK = "topic /chatter 0 01.10.bb 0 01.0f.aa"


def status_with(**changes: Any) -> ProxyStatus:
    domain = DomainStatus(
        **{"peers": ("robot",), "inside": (INSIDE,), "outside": (OUTSIDE,), **changes}
    )
    return ProxyStatus(settings=StatusSettings(ros=("2",)), domains=(domain,))


def made(measures: Measures | None = None, now: float = 0.0, **changes: Any) -> dict[str, Any]:
    return graph_document(status_with(**changes), None, measures or Measures(), (), now, 900.0)


def test_participants_and_what_crosses_the_boundary() -> None:
    document = made()
    assert document["nodes"]["0 01.0f.aa"]["lane"] == "container"
    assert document["nodes"]["0 01.10.bb"]["lane"] == "robot"
    assert document["nodes"]["0 01.0f.aa"]["rate"] == 120.0
    link = document["links"][LINK]
    assert (link["carried"], link["port"], link["state"]) == ("kernel", 11402, "ok")
    assert not {"hz", "since", "flows"} & link.keys(), "user data is not read"
    for topic in ("/rosout", "ros_discovery_info"):
        assert document["links"][f"topic {topic} 0 01.10.bb 0 01.0f.aa"]["quiet"]
    assert "quiet" not in link
    assert "master" not in document["nodes"]


def test_a_participant_has_the_names_of_its_nodes_else_its_address() -> None:
    """The GUID prefix is in the details alone."""
    names: dict[str, tuple[str, ...]] = {
        "01.0f.01": ("/talker",),
        "01.0f.02": ("/arm", "/hand"),
        "01.0f.03": ("/a", "/b", "/c"),
        "01.0f.04": (),
        "01.0f.05": (),
    }
    inside = tuple(replace(INSIDE, guid_prefix=key, nodes=nodes) for key, nodes in names.items())
    nodes = made(inside=inside)["nodes"]
    assert [nodes[f"0 {prefix}"]["label"] for prefix in names] == [
        "/talker",
        "/arm and /hand",
        "/a and 2 more",
        "172.30.0.5 #1",
        "172.30.0.5 #2",
    ]
    assert nodes["0 01.10.bb"]["label"] == "10.0.0.9"
    assert nodes["0 01.0f.01"]["detail"] == "participant 01.0f.01"
    assert nodes["0 01.0f.03"]["detail"] == "nodes /a, /b, /c; participant 01.0f.03"


def test_names_of_hostile_nodes_are_short_and_harmless() -> None:
    names = tuple(f"/{number}\x1b{'x' * 300}" for number in range(2000))
    node = made(inside=(replace(INSIDE, nodes=names),))["nodes"]["0 01.0f.aa"]
    assert len(node["label"]) <= 300
    assert len(node["detail"]) <= 1000
    assert "\x1b" not in node["label"] + node["detail"]


BUSY = replace(DATA, user_datagrams=7, user_rate=1234.0, user_datagram_rate=5.0)


def measures_of(link: dict[str, Any]) -> dict[str, Any]:
    names = ("rate", "datagrams", "since", "flows", "shared")
    return {name: link[name] for name in names if name in link}


def test_the_data_of_the_only_link_to_a_participant() -> None:
    """Quiet topics have none: they carry next to nothing."""
    links = made(inside=(replace(INSIDE, leases=(BUSY,)),))["links"]
    assert measures_of(links[LINK]) == {"rate": 1200.0, "datagrams": 5.0, "flows": True}
    quiet = [link for link in links.values() if link.get("quiet")]
    assert len(quiet) == 2
    assert not any(map(measures_of, quiet))


def test_links_to_one_participant_share_its_data() -> None:
    """If all come from one participant, data flows between the two, on whichever topic."""
    near = replace(INSIDE, leases=(BUSY,), subscribes=("/chatter", "/scan"))
    far = replace(OUTSIDE, publishes=("/chatter", "/scan"))
    shares = {"rate": 1200.0, "datagrams": 5.0, "shared": 2}
    links = made(inside=(near,), outside=(far,))["links"]
    assert [measures_of(link) for link in links.values()] == [shares | {"flows": True}] * 2
    other = replace(far, guid_prefix="01.10.cc", publishes=("/scan",))
    links = made(inside=(near,), outside=(replace(far, publishes=("/chatter",)), other))["links"]
    assert [measures_of(link) for link in links.values()] == [shares] * 2
    serves = replace(near, subscribes=("/chatter",), services=("/add", "/x/get_parameters"))
    link = made(inside=(serves,), outside=(far,))["links"][LINK]
    assert measures_of(link) == shares | {"flows": True}, "requests arrive there, too"
    asks = replace(other, publishes=())
    link = made(inside=(serves,), outside=(far, asks))["links"][LINK]
    assert measures_of(link) == shares, "the requests may be of another participant"


@pytest.mark.parametrize(("plane", "is_certain"), [("copy", True), ("kernel", False)])
def test_the_kernel_counts_acknowledgements_for_what_a_participant_publishes(
    plane: str, is_certain: bool
) -> None:
    near = replace(INSIDE, leases=(replace(BUSY, plane=plane),), publishes=("/plan",))
    far = replace(OUTSIDE, subscribes=("/plan",))
    measures = measures_of(made(inside=(near,), outside=(far,))["links"][LINK])
    assert measures.get("flows", False) is is_certain
    assert measures.get("shared", 0) == (0 if is_certain else 2)


def test_a_port_without_data_has_carried_nothing_since_the_last_datagram() -> None:
    idle = replace(BUSY, user_rate=0.0, user_datagram_rate=0.0)
    measures = Measures()
    nothing = {"rate": 0.0, "datagrams": 0.0}
    for now, count, expected in (
        (100.0, 7, nothing),
        (101.0, 8, {"flows": True}),
        (103.0, 8, {"flows": True}),
        (104.0, 8, nothing | {"since": 1001}),
    ):
        inside = (replace(INSIDE, leases=(replace(idle, user_datagrams=count),)),)
        measures.read_participants(received(status_with(inside=inside)), now)
        assert measures_of(made(measures, now, inside=inside)["links"][LINK]) == expected


@pytest.mark.parametrize(("direction", "is_counted"), [("out", False), ("both", True)])
def test_of_data_past_the_proxy_nothing_is_known(direction: str, is_counted: bool) -> None:
    near = replace(INSIDE, publishes=("/chatter",), subscribes=())
    far = replace(OUTSIDE, subscribes=("/chatter",), publishes=(), leases=(BUSY,))
    document = made(inside=(near,), outside=(far,), direction=direction)
    (link,) = document["links"].values()
    assert bool(measures_of(link)) is is_counted
    counted = received(status_with(inside=(near,), outside=(far,), direction=direction))
    assert ("0 01.10.bb" in counted) is is_counted


def test_a_broken_link_has_no_share_in_the_data() -> None:
    pair = MismatchStatus(
        "topic", "/scan", "reliability", "BEST_EFFORT", "RELIABLE", "01.10.bb", "01.0f.aa"
    )
    near = replace(INSIDE, leases=(BUSY,), subscribes=("/chatter", "/scan"))
    far = replace(OUTSIDE, publishes=("/chatter", "/scan"))
    links = made(inside=(near,), outside=(far,), mismatches=(pair,))["links"]
    assert not measures_of(links[LINK.replace("chatter", "scan")])
    assert measures_of(links[LINK]) == {"rate": 1200.0, "datagrams": 5.0, "flows": True}


def test_a_mismatch_is_on_its_link_alone() -> None:
    other = ParticipantStatus("01.10.cc", "10.0.0.8", "Cyclone DDS", publishes=("/chatter",))
    pair = MismatchStatus(
        "topic", "/chatter", "reliability", "BEST_EFFORT", "RELIABLE", "01.10.bb", "01.0f.aa"
    )
    links = made(outside=(OUTSIDE, other), mismatches=(pair,))["links"]
    assert links[LINK]["state"] == "broken"
    assert "reliability differs" in links[LINK]["text"]
    assert "make the publisher RELIABLE" in links[LINK]["fix"]
    assert links["topic /chatter 0 01.10.cc 0 01.0f.aa"]["state"] == "ok"


def test_a_mismatch_that_a_link_shows_is_no_finding() -> None:
    """A mismatch without a link stays a finding."""
    pair = MismatchStatus(
        "topic", "/chatter", "reliability", "BEST_EFFORT", "RELIABLE", "01.10.bb", "01.0f.aa"
    )
    document = made(mismatches=(pair, replace(pair, name="/left_out")))
    assert [f["subject"] for f in document["findings"]] == ["topic /left_out"]


def test_a_service_that_does_not_match_is_broken_between_its_ends() -> None:
    server = replace(INSIDE, services=("/add",))
    asks = ("01.10.bb", "01.0f.aa")
    replies = ("01.0f.aa", "01.10.bb")
    for writer, reader in (asks, replies):
        pair = MismatchStatus("service", "/add", "type", "A", "B", writer, reader)
        document = made(inside=(server,), mismatches=(pair,))
        broken = document["links"]["service /add 0 01.0f.aa 0 01.10.bb"]
        assert (broken["state"], "type differs" in broken["text"]) == ("broken", True)
        assert broken["fix"]
        assert document["links"]["service /add 0 01.0f.aa "]["state"] == "ok"
        assert not document["findings"]
    alone = made(mismatches=(MismatchStatus("service", "/add", "type", "A", "B", *asks),))
    assert [f["subject"] for f in alone["findings"]] == ["service /add"]


@pytest.mark.parametrize("is_inwards", [True, False])
def test_a_hidden_topic_is_not_ok(is_inwards: bool) -> None:
    kind = "subscribe" if is_inwards else "publish"
    hidden = HiddenStatus(kind, "/chatter", "01.0f.aa", "rule deny subscribe /chatter")
    ends = [INSIDE, OUTSIDE]
    if not is_inwards:
        ends = [replace(p, publishes=p.subscribes, subscribes=p.publishes) for p in ends]
    status = status_with(inside=(ends[0],), outside=(ends[1],))
    status = replace(status, policy=PolicyStatus(hidden=(hidden,)))
    links = graph_document(status, None, Measures(), (), 0.0, 900.0)["links"]
    (link,) = (link for link in links.values() if link["name"] == "/chatter")
    assert link["state"] == "warning"
    assert link["text"].startswith("hidden from outside by the policy: rule deny subscribe")
    assert link["fix"] == "if outside may use the name, change this rule"
    assert not {"carried", "port", "rate"} & link.keys()
    assert [link["state"] for link in links.values() if link["name"] == "/rosout"] == ["ok"]


def test_a_hidden_service_is_not_ok() -> None:
    server = replace(INSIDE, services=("/add", "/sum"))
    hidden = HiddenStatus("serve", "/add", "01.0f.aa", "rule deny serve /add")
    status = replace(status_with(inside=(server,)), policy=PolicyStatus(hidden=(hidden,)))
    links = graph_document(status, None, Measures(), (), 0.0, 900.0)["links"]
    assert links["service /add 0 01.0f.aa "]["state"] == "warning"
    assert links["service /sum 0 01.0f.aa "]["state"] == "ok"


def test_a_mismatch_counts_more_than_a_warning_about_a_participant() -> None:
    pair = MismatchStatus(
        "topic", "/chatter", "reliability", "BEST_EFFORT", "RELIABLE", "01.10.bb", "01.0f.aa"
    )
    unheard = replace(OUTSIDE, proven=False)
    link = made(outside=(unheard,), mismatches=(pair,))["links"][LINK]
    assert (link["state"], "reliability differs" in link["text"]) == ("broken", True)
    assert made(outside=(unheard,))["links"][LINK]["state"] == "warning"


@pytest.mark.parametrize(("direction", "inwards"), [("out", True), ("out", False), ("both", False)])
def test_a_participant_of_one_port_gets_its_data_there(direction: str, inwards: bool) -> None:
    """Cyclone DDS has the same port for discovery and user data, and outside a stand-in for
    discovery.
    """
    port = replace(DATA, kind="metatraffic", plane="copy")
    writes, reads = (
        {"leases": (port,), "publishes": publishes, "subscribes": subscribes}
        for publishes, subscribes in ((("/chatter",), ()), ((), ("/chatter",)))
    )
    near = replace(INSIDE, **(reads if inwards else writes))
    far = replace(OUTSIDE, **(writes if inwards else reads))
    document = made(direction=direction, inside=(near,), outside=(far,))
    (link,) = document["links"].values()
    is_passed = inwards or direction == "both"
    assert (link["carried"], link.get("port")) == (
        ("copy", 11402) if is_passed else ("direct", None)
    )
    assert ("rate" in document["nodes"]["0 01.10.bb"]) is (direction == "both")
    assert document["nodes"]["0 01.0f.aa"]["rate"] == 120.0


def test_a_participant_that_is_wrong_breaks_its_links() -> None:
    wrong = ParticipantStatus(
        "01.10.bb", "10.0.0.9", "Fast DDS", publishes=("/chatter",), locator_fault="tcp"
    )
    document = made(outside=(wrong,))
    assert document["nodes"]["0 01.10.bb"]["state"] == "broken"
    assert "passes on UDP" in document["links"][LINK]["text"]


def test_a_service_of_a_participant_that_is_wrong_has_the_fix() -> None:
    wrong = ParticipantStatus(
        "01.0f.aa", "172.30.0.5", "Fast DDS", services=("/add",), locator_fault="tcp"
    )
    link = made(inside=(wrong,))["links"]["service /add 0 01.0f.aa "]
    assert (link["state"], "passes on UDP" in link["text"]) == ("broken", True)
    assert link["fix"]


@pytest.mark.parametrize(("direction", "carried"), [("out", "direct"), ("both", None)])
def test_what_goes_outwards_by_itself_is_carried_directly(
    direction: str, carried: str | None
) -> None:
    talker = ParticipantStatus("01.0f.aa", "172.30.0.5", "Fast DDS", publishes=("/chatter",))
    listener = ParticipantStatus("01.10.bb", "10.0.0.9", "Fast DDS", subscribes=("/chatter",))
    document = made(direction=direction, inside=(talker,), outside=(listener,))
    assert document["links"]["topic /chatter 0 01.0f.aa 0 01.10.bb"].get("carried") == carried


def test_what_concerns_nobody_alone_is_a_finding() -> None:
    (finding,) = made(peers=())["findings"]
    assert finding["fix"].startswith("set --ros2-peer ADDRESS; or run rosproxy lan-relay and set ")
