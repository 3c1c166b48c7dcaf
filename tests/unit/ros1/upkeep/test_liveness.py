"""Which nodes are gone or have moved, as the news of containers say and the nodes themselves."""

from dataclasses import replace

import pytest

from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import Endpoint, Place
from rosproxy.ros1.registry.health import ProbeResult
from rosproxy.ros1.upkeep.policy import liveness
from tests.unit.builders import add_node, add_registration, make_addressing


def test_only_who_answers_is_alive() -> None:
    addressing = make_addressing()
    found = [add_node(addressing, f"http://10.0.0.5:4000{n}/") for n in range(3)]
    probes = [ProbeResult.ANSWERED, ProbeResult.REFUSED, ProbeResult.SILENT]
    assert liveness.dead(dict(zip(found, probes, strict=True)), 0.0) == found[1:]


def test_restarted_container_keeps_its_new_node() -> None:
    """Its address is back, and its node has just registered, but takes its time to answer."""
    addressing = make_addressing()
    fresh, old, calling, ended = (
        add_node(addressing, f"http://10.0.0.5:4000{n}/") for n in range(4)
    )
    for endpoint, since in ((fresh, 7.0), (old, 6.9), (ended, 8.0)):
        held = add_registration(addressing, endpoint, Kind.PUBLISHER, "/chatter", f"/at{since}")
        addressing.registry.register(endpoint, replace(held, since=since))
    calling.pending = 1
    answers = dict.fromkeys((fresh, old, calling), ProbeResult.SILENT) | {
        ended: ProbeResult.REFUSED
    }
    assert liveness.dead(answers, 7.0) == [old, ended]


def test_who_may_have_moved() -> None:
    addressing = make_addressing()
    moved = add_node(addressing)
    add_node(addressing, "http://10.0.0.6:40001/")
    outside = add_node(addressing, "http://10.0.0.7:40001/")
    same = add_node(addressing, "http://10.0.0.8:40001/")
    news = {
        moved.place.address: "10.0.0.9",
        outside.place.address: "192.168.0.9",  # in no inside network
        same.place.address: same.place.address,
        "10.0.0.99": "10.0.0.100",
    }
    found = liveness.movable(addressing.registry, news, addressing.networks)
    assert found == {moved: "10.0.0.9"}


@pytest.mark.parametrize(
    ("uri", "stale"),
    [
        ("http://10.0.0.5:40001/", True),
        ("http://10.0.0.9:40001/", False),
        ("http://c1:40001/", False),
        ("http://localhost:40001/", False),
        ("http://127.0.0.1:40001/", False),
    ],
)
@pytest.mark.parametrize("confirmed", [True, False])
def test_the_place_of_a_node_that_has_moved(uri: str, stale: bool, confirmed: bool) -> None:
    endpoint = add_node(make_addressing(), uri, "10.0.0.5", True, confirmed)
    expected = Place("10.0.0.9", named=False, confirmed=confirmed, stale=stale)
    assert liveness.new_place(endpoint, "10.0.0.9") == expected


def endpoint_with(pid: int | None, *topics: str) -> Endpoint:
    addressing = make_addressing()
    endpoint = add_node(addressing)
    endpoint.health.pid = pid
    for topic in topics:
        add_registration(addressing, endpoint, Kind.PUBLISHER, topic)
    return endpoint


SAME = [
    # pid known, topics known, pid found, topics found, same?
    (7, ["/a"], 7, {"/a"}, True),
    (7, ["/a", "/rosout"], 7, {"/a", "/b"}, True),
    (7, ["/a"], 8, {"/a"}, False),
    (7, ["/a"], None, {"/a"}, False),
    (1, ["/a", "/rosout"], 1, {"/b", "/rosout"}, False),  # pid 1, as in every container
    (7, ["/rosout"], 7, {"/rosout"}, True),
    (7, [], 7, set(), True),
    (7, [], 8, {"/a"}, False),
    (None, ["/a"], 7, {"/a"}, True),  # recovered, and not asked yet
    (-1, ["/a"], 7, {"/a"}, True),  # suspected
    (None, ["/a"], 7, {"/b"}, False),
    (None, [], 7, {"/a"}, False),
]


@pytest.mark.parametrize(("known", "topics", "pid", "said", "same"), SAME)
def test_whether_it_is_the_same_process(
    known: int | None, topics: list[str], pid: int | None, said: set[str], same: bool
) -> None:
    endpoint = endpoint_with(known, *topics)
    assert liveness.is_same_process(endpoint, pid, said) is same
