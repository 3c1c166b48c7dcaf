"""The places of proxies: order, words, and the master of a graph."""

import pytest

from rosproxy.shared.addresses import HostPort
from rosproxy_operator.proxy_spec.place import ZENOH, Domain, Graph, Master, Place, ZenohNetwork

ROBOT = Master("http://robot:11311")


@pytest.mark.parametrize(
    ("graph", "ros", "text"),
    [
        (ROBOT, "1", "master http://robot:11311"),
        (Domain(7), "2", "ROS 2 domain 7"),
        (ZenohNetwork(), "zenoh", "zenoh network"),
    ],
)
def test_a_graph_has_a_version_of_ros_and_words(graph: Graph, ros: str, text: str) -> None:
    assert graph.ros == ros
    assert str(graph) == text


def test_places_of_all_kinds_have_an_order() -> None:
    places = [
        ZENOH,
        Place(Domain(0), "192.0.2.1"),
        Place(Domain(1), "192.0.2.1"),
        Place(Domain(0), "192.0.2.2"),
        Place(Master("http://arm:11311"), "192.0.2.1"),
        Place(ROBOT, "192.0.2.1"),
        Place(ROBOT, "192.0.2.2"),
    ]
    assert sorted({*places}) == places


def test_graphs_of_other_kinds_differ() -> None:
    assert len({Place(ROBOT, ""), Place(Domain(0), ""), ZENOH}) == 3


def test_the_master_of_a_place() -> None:
    assert Place(ROBOT, "192.0.2.1").master.host_port == HostPort("robot", 11311)
    with pytest.raises(ValueError, match="'robot:11311' is no master's URI"):
        _ = Place(Master("robot:11311"), "192.0.2.1").master.port
    with pytest.raises(ValueError, match="the ROS 2 domain 7 has no master"):
        _ = Place(Domain(7), "192.0.2.1").master
