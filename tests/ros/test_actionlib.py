"""Actions work: five topics between two nodes, both ways at the same time."""

from __future__ import annotations

from tests.ros.combinations import each_way_in_turn
from tests.ros.lab import Lab

SUCCEEDED = 3
PREEMPTED = 2


@each_way_in_turn("server", "client")
def test_a_goal_gives_feedback_and_a_result(
    lab: Lab, server: str, client: str, source: str, sink: str
) -> None:
    action = f"/{lab.unique('add')}"
    serving = lab.node(server, source, "actionserver", action=action)
    caller = lab.node(client, sink, "actionclient", action=action, a=40, b=2)
    serving.wait_for("^goal 40 2$")
    caller.wait_for("^feedback$")
    caller.wait_for(f"^finished 1 state {SUCCEEDED} sum 42$")


@each_way_in_turn("server", "client")
def test_a_goal_is_cancelled(lab: Lab, server: str, client: str, source: str, sink: str) -> None:
    action = f"/{lab.unique('long')}"
    serving = lab.node(server, source, "actionserver", action=action, seconds=30)
    caller = lab.node(client, sink, "actionclient", action=action, cancel=1)
    serving.wait_for("^preempted$")
    caller.wait_for(f"^finished 1 state {PREEMPTED} ")
