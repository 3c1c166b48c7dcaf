"""The document of a proxy for ROS 2."""

from typing import Any

import pytest
from msgspec.structs import replace

from rosproxy.admin.status_document import (
    DomainStatus,
    LocatorStatus,
    MismatchStatus,
    ParticipantStatus,
    ProxyStatus,
    StatusSettings,
)
from rosproxy.page.graph_document import graph_document
from rosproxy.page.measures import Measures

DATA = LocatorStatus(11402, "172.30.0.5:7411", "data", rate=123.0, plane="kernel")
INSIDE = ParticipantStatus(
    "01.0f.aa", "172.30.0.5", "Fast DDS", (DATA,), subscribes=("/chatter", "/rosout")
)
OUTSIDE = ParticipantStatus(
    "01.10.bb", "10.0.0.9", "Cyclone DDS", publishes=("/chatter", "/rosout")
)
LINK = "topic /chatter 0 01.10.bb 0 01.0f.aa"


def made(**changes: Any) -> dict[str, Any]:
    domain = DomainStatus(
        **{"peers": ("robot",), "inside": (INSIDE,), "outside": (OUTSIDE,), **changes}
    )
    status = ProxyStatus(settings=StatusSettings(ros=("2",)), domains=(domain,))
    return graph_document(status, None, Measures(), (), 0.0, 0.0)


def test_participants_and_what_crosses_the_boundary() -> None:
    document = made()
    assert document["nodes"]["0 01.0f.aa"]["lane"] == "container"
    assert document["nodes"]["0 01.10.bb"]["lane"] == "robot"
    assert document["nodes"]["0 01.0f.aa"]["rate"] == 120.0
    link = document["links"][LINK]
    assert (link["carried"], link["port"], link["state"]) == ("kernel", 11402, "ok")
    assert not {"hz", "rate", "since"} & link.keys(), "user data is not read"
    assert document["links"]["topic /rosout 0 01.10.bb 0 01.0f.aa"]["quiet"]
    assert "master" not in document["nodes"]


def test_participants_of_one_container_have_labels_of_their_own() -> None:
    """Fast DDS tells processes by the bytes in the middle; the last ones are 0 for all of them."""
    prefixes = [
        "01.0f.a1.b2.17.00.c3.d4.00.00.00.00",
        "01.0f.a1.b2.18.00.c3.d5.00.00.00.00",
        "01.0f.a1.b2.18.00.c3.d5.01.00.00.00",
        "01.10.5e.92.7c.0d.11.aa.00.00.01.c1",
    ]
    inside = tuple(replace(INSIDE, guid_prefix=prefix) for prefix in prefixes)
    nodes = made(inside=inside)["nodes"]
    assert [nodes[f"0 {prefix}"]["label"] for prefix in prefixes] == [
        "172.30.0.5 17.00.c3.d4",
        "172.30.0.5 18.00.c3.d5",
        "172.30.0.5 18.00.c3.d5.01.00.00.00",
        "172.30.0.5 7c.0d.11.aa.00.00.01.c1",
    ]


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


def test_a_participant_that_is_wrong_breaks_its_links() -> None:
    wrong = ParticipantStatus(
        "01.10.bb", "10.0.0.9", "Fast DDS", publishes=("/chatter",), locator_fault="tcp"
    )
    document = made(outside=(wrong,))
    assert document["nodes"]["0 01.10.bb"]["state"] == "broken"
    assert "passes on UDP" in document["links"][LINK]["text"]


def test_a_service_of_a_participant_that_is_wrong_has_the_cure() -> None:
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
    assert finding["fix"] == "give --ros2-peer, or run rosproxy ear (--ros2-ear)"
