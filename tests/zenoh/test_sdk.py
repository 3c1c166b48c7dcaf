"""Nodes of zenoh-ros2-sdk, a second implementation of rmw_zenoh's keys, tokens and payloads."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress

import pytest

from tests.ros.processes import wait_until
from tests.zenoh.lab import PORTS, VERSIONS, Lab

ARRIVE_WITHIN_S = 60.0
PLACES = ("c2", "out")
"""The other container, and the robot."""


def expected(sdk: str, offers: list[str]) -> Iterator[str]:
    """The lines that each node prints which uses the node of the library."""
    yield from (f"got {sdk} topic", f"got {sdk} sum 3")
    yield f"listed {sdk}_talker MP %{sdk}%chatter"
    yield f"listed {sdk}_server SS %{sdk}%add"
    for offer in offers:
        yield f"listed {sdk}_listener MS %{offer}%chatter"
        yield f"listed {sdk}_client SC %{offer}%add"


@pytest.mark.parametrize(
    ("way", "version"), [*(("redirect", version) for version in VERSIONS), ("client", VERSIONS[0])]
)
def test_a_node_of_another_library_exchanges_all(lab: Lab, way: str, version: str) -> None:
    """The library computes the type hashes from the definitions of the types."""
    lab.start_router(version)
    for role in PORTS if way == "redirect" else ():
        lab.redirect(role)
    lab.start_proxy()
    lab.wait_for_link()
    offers = [lab.node(version, role, "offer", "-") for role in PLACES]
    for offer in offers:
        offer.wait_for("^latched$", timeout=30)
    titles = [offer.title for offer in offers]
    sdk = lab.sdk_node("c1", titles)
    users = [lab.node(version, role, "use", sdk.title) for role in PLACES]
    wanted = {user: {*expected(sdk.title, titles)} for user in users}
    wanted[sdk] = {f"got {offer} {use}" for offer in titles for use in ("topic", "sum 3")}

    def missing() -> dict[str, list[str]]:
        told = {node: {*node.output().splitlines()} for node in wanted}
        return {n.title: sorted(gone) for n, seen in told.items() if (gone := wanted[n] - seen)}

    with suppress(AssertionError):  # the next line tells more
        wait_until("everything arrives", lambda: not missing(), ARRIVE_WITHIN_S)
    assert missing() == {}
    check_status(lab, sdk.title, titles)
    sdk.kill()
    for user in users:
        user.wait_for(f"^gone {sdk.title}_talker$", timeout=30)


def check_status(lab: Lab, sdk: str, offers: list[str]) -> None:
    """The status has each entity of the library with its type, and no pair that does not match."""
    chatter = "std_msgs/msg/String"
    add = "example_interfaces/srv/AddTwoInts"
    entities = {(f"/{sdk}_talker", f"/{sdk}/chatter", chatter)}
    entities |= {(f"/{sdk}_server", f"/{sdk}/add", add)}
    entities |= {(f"/{sdk}_listener", f"/{offer}/chatter", chatter) for offer in offers}
    entities |= {(f"/{sdk}_client", f"/{offer}/add", add) for offer in offers}

    def known() -> set[tuple[str, str, str]]:
        address = lab.topology.places["c1"].address
        nodes = [node for node in lab.zenoh().nodes if node.address == address]
        return {(node.name, named.name, named.type) for node in nodes for named in node.types}

    wait_until("the status has all entities", lambda: known() == entities, 10)
    assert lab.zenoh().mismatches == ()
