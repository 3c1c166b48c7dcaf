"""What the tests of rollouts in a cluster count as an absence of a proxy."""

from tests.kubernetes.rollout import Absence, Sight, absences


def seen(at: float, node: str = "node1", **changes: object) -> Sight:
    facts = {"uid": f"of-{node}", "image": "old", "restarts": 0, "ready": True, "gone": False}
    return Sight(at, node, **{**facts, **changes})  # type: ignore[arg-type]


def test_a_proxy_with_another_image_is_away_until_its_container_is_ready_again() -> None:
    """The pod stays ready until the kubelet has ended the former container."""
    sights = (
        seen(0),
        seen(1, image="new"),
        seen(2, image="new", ready=False, restarts=1),
        seen(3, image="new", restarts=1),
        seen(4, "node2"),
    )
    assert [*absences(sights)] == [Absence("node1", 1, 3)]


def test_a_recreated_proxy_is_away_until_its_successor_is_ready() -> None:
    sights = (
        seen(0),
        seen(1, gone=True),
        seen(2, gone=True, ready=False),
        seen(3, uid="b", image="new", ready=False),
        seen(4, gone=True, ready=False),
        seen(5, uid="b", image="new"),
    )
    assert [*absences(sights)] == [Absence("node1", 1, 5)]


def test_absences_of_two_proxies_may_overlap() -> None:
    sights = (seen(0), seen(1, ready=False), seen(2, "node2", ready=False), seen(3))
    assert [*absences(sights)] == [Absence("node1", 1, 3), Absence("node2", 2, float("inf"))]
