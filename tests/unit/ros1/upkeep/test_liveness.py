"""Nodes that are gone or have moved, by updates of containers and by answers of nodes."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import NodeLocation
from rosproxy.ros1.registry.node_health import Health, ProbeResult
from rosproxy.ros1.upkeep.decisions import liveness
from rosproxy.ros1.upkeep.decisions.liveness import AfterAnswer
from tests.unit.builders import add_node, add_registration, make_addressing


def test_only_who_answers_is_alive() -> None:
    addressing = make_addressing()
    endpoints = [add_node(addressing, f"http://10.0.0.5:4000{n}/") for n in range(3)]
    probes = [ProbeResult.ANSWERED, ProbeResult.REFUSED, ProbeResult.SILENT]
    assert liveness.dead_endpoints(dict(zip(endpoints, probes, strict=True)), 0.0) == endpoints[1:]


def test_restarted_container_keeps_its_new_node() -> None:
    """The address is back. The node has just registered, but answers slowly."""
    addressing = make_addressing()
    fresh, old, calling, ended = (
        add_node(addressing, f"http://10.0.0.5:4000{n}/") for n in range(4)
    )
    for endpoint, since in ((fresh, 7.0), (old, 6.9), (ended, 8.0)):
        registration = add_registration(
            addressing, endpoint, Kind.PUBLISHER, "/chatter", f"/at{since}"
        )
        addressing.registry.register(endpoint, replace(registration, since=since))
    calling.pending = 1
    answers = dict.fromkeys((fresh, old, calling), ProbeResult.SILENT) | {
        ended: ProbeResult.REFUSED
    }
    assert liveness.dead_endpoints(answers, 7.0) == [old, ended]


def test_who_may_have_moved() -> None:
    addressing = make_addressing()
    moved = add_node(addressing)
    add_node(addressing, "http://10.0.0.6:40001/")
    outside = add_node(addressing, "http://10.0.0.7:40001/")
    same = add_node(addressing, "http://10.0.0.8:40001/")
    update = {
        moved.location.address: "10.0.0.9",
        outside.location.address: "192.168.0.9",  # in no inside network
        same.location.address: same.location.address,
        "10.0.0.99": "10.0.0.100",
    }
    moves = liveness.new_addresses(addressing.registry, update, addressing.networks)
    assert moves == {moved: "10.0.0.9"}


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
    expected = NodeLocation("10.0.0.9", named=False, confirmed=confirmed, stale=stale)
    assert liveness.moved_location(endpoint, "10.0.0.9") == expected


SAME = [
    # known pid, found pid, whether the topics confirm the node, same process?
    (7, 7, True, True),
    (7, 8, True, False),
    (1, 1, False, False),  # pid 1, as in every container
    (7, 7, None, True),  # no topics, or no answer about topics
    (7, 8, None, False),
    (7, None, True, True),  # no answer about the pid any more
    (7, None, None, False),
    (None, 7, True, True),  # recovered, and not asked yet
    (-1, 7, True, True),  # suspected
    (None, 7, False, False),
    (None, 7, None, False),
    (None, None, True, True),
    (None, None, None, False),
]


@pytest.mark.parametrize(("former_pid", "pid", "is_confirmed", "same"), SAME)
def test_whether_it_is_the_same_process(
    former_pid: int | None, pid: int | None, is_confirmed: bool | None, same: bool
) -> None:
    assert liveness.is_same_process(former_pid, pid, is_confirmed) is same


TIMES = st.none() | st.integers(0, 12).map(float)
HEALTHS = st.builds(
    Health,
    answered_at=TIMES,
    failures=st.integers(0, 3),
    cleaned=st.booleans(),
    checked_at=TIMES,
    pid=st.sampled_from([None, -1, 7]),
)


@given(
    HEALTHS,
    st.booleans(),
    st.booleans(),
    st.integers(0, 1),
    TIMES,
)
def test_nobody_who_is_due_or_unused_is_passed_over(
    health: Health, registered: bool, direct: bool, connections: int, idle_since: float | None
) -> None:
    addressing = make_addressing()
    endpoint = add_node(addressing)
    if registered:
        add_registration(addressing, endpoint, Kind.PUBLISHER, "/chatter")
    if direct:
        endpoint.former_uris.add(endpoint.uri)
    endpoint.health = health
    endpoint.connections = connections
    endpoint.idle_since = idle_since
    passed_over = not liveness.endpoints_to_check([endpoint], 12.0, 5.0)
    if passed_over:
        assert not liveness.is_due(endpoint, 12.0, 5.0)
        assert not endpoint.unused
        assert endpoint.idle_since is None
    if liveness.may_use_kept_connection(endpoint):
        assert health.pid == 7
        assert not any((health.failures, health.cleaned, direct))


def test_a_thousand_that_are_well_are_passed_over() -> None:
    addressing = make_addressing()
    endpoint = add_node(addressing)
    add_registration(addressing, endpoint, Kind.PUBLISHER, "/chatter")
    endpoint.health.note(ProbeResult.ANSWERED, 10.0)
    assert liveness.endpoints_to_check([endpoint] * 1000, 14.9, 5.0) == []
    assert liveness.endpoints_to_check([endpoint], 15.0, 5.0) == [endpoint]


def test_a_process_that_hangs_up_is_called_from_then_on_and_another_is_not() -> None:
    endpoint = add_node(make_addressing())
    health = endpoint.health
    assert not liveness.may_use_kept_connection(endpoint)  # no answer yet
    health.note(ProbeResult.ANSWERED, 1.0)
    health.pid = 7
    assert liveness.may_use_kept_connection(endpoint)
    health.note_hung_up()
    assert health.probe_due(1.0, 5.0)
    health.note(ProbeResult.ANSWERED, 1.1)
    assert not liveness.may_use_kept_connection(endpoint)
    health.pid = 8
    assert liveness.may_use_kept_connection(endpoint)
    health.suspect()
    assert not liveness.may_use_kept_connection(endpoint)


@pytest.mark.parametrize(
    ("trusted", "cleaned", "known_pid", "direct", "due"),
    [
        (False, True, 7, True, AfterAnswer.VERIFY),
        (True, True, 7, True, AfterAnswer.COME_BACK),
        (True, False, 8, True, AfterAnswer.UNREGISTER_LEFT_OVER),
        (True, False, 7, True, AfterAnswer.RECONCILE),
        (True, False, None, False, AfterAnswer.NOTHING),
        (True, False, 7, False, AfterAnswer.NOTHING),
    ],
)
def test_what_is_due_first_once_a_node_has_answered(
    trusted: bool, cleaned: bool, known_pid: int | None, direct: bool, due: AfterAnswer
) -> None:
    endpoint = add_node(make_addressing())
    endpoint.trusted = trusted
    endpoint.health.cleaned = cleaned
    endpoint.health.pid = known_pid
    if direct:
        endpoint.former_uris.add(endpoint.uri)
    assert liveness.after_answer(endpoint, 7) is due
