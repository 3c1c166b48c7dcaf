"""A container with too many tokens, messages or sessions disturbs no other container."""

from __future__ import annotations

import signal

import pytest

from tests.ros.processes import wait_until
from tests.zenoh.lab import PORTS, Lab

VERSION = "1.6.2"
FILES = 256
"""A limit of open files, with which a router has 43 sessions."""


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


def test_a_program_does_not_answer_for_the_routers(lab: Lab) -> None:
    """zenoh asks only a queryable that says that it has all answers, from any machine."""
    lab.start_router(VERSION)
    lab.start_proxy()
    for role in PORTS:
        lab.redirect(role)
    lab.wait_for_link()
    subscriber = lab.node(VERSION, "c2", "sub")
    lab.node(VERSION, "c1", "pub")
    outside = lab.node(VERSION, "out", "usurp")
    inside = lab.node(VERSION, "c1", "usurp")
    for usurper in (outside, inside):
        usurper.wait_for_count("^asked", 20, timeout=30, since=usurper.mark())
    status = lab.zenoh()
    assert (status.restarts, status.links[0].up) == (0, True)
    assert "f00" not in {session.zid for session in status.sessions}
    subscriber.wait_for_count("^got hello ", 20, timeout=30, since=subscriber.mark())


@pytest.mark.parametrize("hangs", [False, True])
def test_messages_that_may_not_be_dropped_hold_up_no_other_container(
    lab: Lab, *, hangs: bool
) -> None:
    """With the two threads of zenoh for all routers, no message arrived any more."""
    lab.start_router(VERSION)
    lab.start_proxy()
    for role in PORTS:
        lab.redirect(role)
    lab.wait_for_link()
    subscriber = lab.node(VERSION, "out", "sub")
    lab.node(VERSION, "c2", "pub")
    subscriber.wait_for_count("^got hello ", 5, timeout=30)
    slow = lab.node(VERSION, "c2", "count", "images")
    lab.node(VERSION, "c1", "blast", "images", NODE_BYTES="1000000")
    slow.wait_for("^got 1000000", timeout=30)
    if hangs:
        slow.send(signal.SIGSTOP)
    # Some messages pass before all queues are full.
    subscriber.wait_for_count("^got hello ", 40, timeout=60, since=subscriber.mark())
    assert lab.zenoh().restarts == 0


def test_a_message_of_a_container_does_not_fill_the_memory(lab: Lab) -> None:
    """With zenoh's bound of 1 GiB, one message took more memory than most proxies may have."""
    lab.start_proxy(with_robot=False)
    for role in PORTS:
        lab.redirect(role)
    images = lab.node(VERSION, "c2", "count", "images")
    lab.node(VERSION, "c1", "blast", "images", NODE_BYTES="900000000,1000")
    images.wait_for_count("^got 1000$", 3, timeout=60)
    assert "got 900000000" not in images.output()
    assert lab.peak_memory() < 400_000_000
    assert lab.zenoh().restarts == 0


def test_sessions_of_a_container_leave_files_for_other_containers(lab: Lab) -> None:
    """The routers share the open files of a process."""
    lab.start_router(VERSION)
    lab.start_proxy(files=FILES)
    for role in PORTS:
        lab.redirect(role)
    lab.wait_for_link()
    lab.node(VERSION, "out", "pub")
    flood = lab.node(VERSION, "c1", "hoard")
    flood.wait_for_count("^refused", 20, timeout=60)
    subject = f"zenoh router at port {PORTS['c1']}"
    wait_until("the flood is told", lambda: subject in lab.problems(), 30)
    assert "has 43 sessions" in lab.problems()[subject]
    assert "raise the limit of open files" in lab.problems()[subject]
    late = lab.node(VERSION, "c1", "sub")
    other = lab.node(VERSION, "c2", "sub")
    other.wait_for_count("^got hello ", 20, timeout=60)
    assert "got" not in late.output()
    flood.kill()
    late.wait_for("^got hello ", timeout=60)
    wait_until("nothing is told any more", lambda: subject not in lab.problems(), 30)
    assert lab.zenoh().restarts == 0
