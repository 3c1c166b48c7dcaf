"""The same where the container network has no way out but the proxy, with ``--direction both``."""

from __future__ import annotations

from tests.ros.processes import wait_until
from tests.ros2.lab import Lab
from tests.ros2.machines import ISOLATED
from tests.ros2.test_flow import (  # noqa: F401  they are run here as well
    test_actions,
    test_all_nodes_see_each_other,
    test_best_effort,
    test_latched_topics,
    test_messages_in_fragments,
    test_services,
    test_topics,
)
from tests.ros2.test_recovery import (  # noqa: F401
    test_a_node_that_comes_back_is_heard_again,
    test_best_effort_is_back_soon,
    test_ten_participants_get_their_ports_again,
)

PEER = ("--ros2-peer", "10.77.0.2")
PLAN = ISOLATED
OPTIONS = (*PEER, "--direction", "both")


def stand_ins(lab: Lab) -> dict[str, set[tuple[int, str]]]:
    """The ports that stand for locators outside, by participant."""
    return {
        participant.guid_prefix: {(lease.port, lease.where) for lease in participant.leases}
        for participant in lab.domain().outside
    }


def test_ports_that_stand_for_outside_are_the_same_again(lab: Lab) -> None:
    lab.node("jazzy", "c1", "pub", topic="/outward", depth=100)
    reader = lab.node("jazzy", "out", "sub", topic="/outward", depth=100)
    lab.node("kilted", "out", "pub", topic="/inward", depth=100)
    inner = lab.node("jazzy", "c2", "sub", topic="/inward", depth=100)
    for subscriber in (reader, inner):
        subscriber.wait_for_count("^got hello ", 5)
    everything = lambda: [len(ports) for ports in stand_ins(lab).values()] == [3, 3]  # noqa: E731
    wait_until("each locator outside has a stand-in", everything, 30)
    before = stand_ins(lab)
    lab.restart_proxy()
    wait_until("the stand-ins are the same", lambda: stand_ins(lab) == before, 30)
    for subscriber in (reader, inner):
        subscriber.wait_for_count("^got hello ", 10, since=subscriber.mark())
        got = [int(line.split()[2]) for line in subscriber.output().splitlines() if "got " in line]
        assert got == list(range(got[0], got[-1] + 1)), "messages were lost"


def test_without_it_nothing_gets_out(lab: Lab) -> None:
    lab.stop()
    lab.options = PEER
    lab.start_proxy()
    lab.node("jazzy", "c1", "pub", topic="/outward")
    outer = lab.node("jazzy", "out", "sub", topic="/outward")
    inner = lab.node("jazzy", "c2", "sub", topic="/outward")
    lab.wait_for_participants(2, 1)
    inner.wait_for_count("^got hello ", 30)
    assert "got " not in outer.output()
