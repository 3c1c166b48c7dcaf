"""A container with too many tokens disturbs no other container."""

from __future__ import annotations

from tests.ros.processes import wait_until
from tests.zenoh.lab import PORTS, Lab

VERSION = "1.6.2"


def test_tokens_of_a_container_do_not_end_the_routers(lab: Lab) -> None:
    """In JSON each of these letters took twelve bytes: the report of all tokens was too long."""
    lab.start_proxy(with_robot=False)
    for role in PORTS:
        lab.redirect(role)
    subscriber = lab.node(VERSION, "c2", "sub")
    lab.node(VERSION, "c1", "pub")
    subscriber.wait_for_count("^got hello ", 5, timeout=30)
    crowd = lab.node(VERSION, "c1", "crowd", NODE_TOKENS="1800", NODE_LETTER="\U0001f916")
    crowd.wait_for("declared", timeout=60)
    wait_until("the tokens are counted", lambda: lab.zenoh().left_out >= 1800, 60)
    subscriber.wait_for_count("^got hello ", 20, timeout=30, since=subscriber.mark())
    assert lab.zenoh().restarts == 0
