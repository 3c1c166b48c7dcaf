"""When a new hub is needed, because zenoh does not dial a lost router again."""

import pytest

from rosproxy.zenoh.redialing import GRACE_S, INTERVAL_S, Redialing

ROBOT = "tcp/robot:7447"
CLOUD = "tls/cloud:7447"


@pytest.mark.parametrize(("lost", "connected"), [(0.0, 10.0), (10.0, 0.0)])
def test_a_router_that_is_not_dialed_any_more_needs_a_new_hub_once(
    lost: float, connected: float
) -> None:
    redialing = Redialing()
    assert redialing.due({ROBOT: lost}, {ROBOT: connected}, 10.0 + GRACE_S - 0.1) == []
    assert redialing.due({ROBOT: lost}, {ROBOT: connected}, 10.0 + GRACE_S) == [ROBOT]
    assert redialing.due({ROBOT: lost}, {ROBOT: connected}, 10.0 + GRACE_S + INTERVAL_S) == []


def test_a_router_that_is_dialed_needs_no_new_hub() -> None:
    assert Redialing().due({ROBOT: 0.0}, {CLOUD: 0.0}, 1000.0) == []


def test_each_loss_of_a_session_may_need_a_new_hub() -> None:
    redialing = Redialing()
    assert redialing.due({ROBOT: 0.0}, {ROBOT: 0.0}, 100.0) == [ROBOT]
    assert redialing.due({}, {ROBOT: 101.0}, 105.0) == []
    assert redialing.due({ROBOT: 110.0}, {ROBOT: 101.0}, 100.0 + INTERVAL_S) == [ROBOT]


@pytest.mark.parametrize("later", [1.0, INTERVAL_S - 0.1])
def test_a_router_that_ends_its_sessions_can_not_interrupt_others_often(later: float) -> None:
    redialing = Redialing()
    connected = {ROBOT: 0.0, CLOUD: 0.0}
    assert redialing.due({ROBOT: 0.0}, connected, 100.0) == [ROBOT]
    down = {ROBOT: 0.0, CLOUD: 90.0}
    assert redialing.due(down, connected, 100.0 + later) == []
    assert redialing.due(down, connected, 100.0 + INTERVAL_S) == [CLOUD]
