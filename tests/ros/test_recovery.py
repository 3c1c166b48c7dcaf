"""Proxy killed and restarted, roscore killed and restarted: the nodes just go on."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable

import pytest

from tests.ros.combinations import LIBRARIES, each_library, each_pair, each_way_in_turn
from tests.ros.lab import ROSCORE, Lab
from tests.ros.processes import Process

pytestmark = pytest.mark.boundary

MASTER = ROSCORE

HARD_LIMIT = 24.0
"""Seconds; what was measured is in the report, far below."""

SIDES = {"c1": "inside", "c2": "inside", "out": "outside"}

Measure = Callable[[str, float], None]


def restart_proxy(lab: Lab) -> float:
    """Kills the proxy with SIGKILL and restarts the proxy. Returns the time of the start."""
    assert lab.proxy is not None
    lab.proxy.kill()
    started = time.time()
    lab.start_proxy()
    return started


def restart_master(lab: Lab) -> float:
    """Kills roscore with SIGKILL and restarts roscore. Returns the time of the first answer."""
    assert lab.master is not None
    lab.master.kill()
    lab.start_master()
    return lab.master_answered


def next_time(process: Process, pattern: str, started: float) -> float:
    """Seconds from `started` to the next matching line."""
    deadline = time.monotonic() + HARD_LIMIT
    while time.monotonic() < deadline:
        lines = process.wait_for_count(rf"{pattern}.* at ([\d.]+)$", 1, HARD_LIMIT)
        later = [float(line[1]) for line in lines if float(line[1]) > started]
        if later:
            return later[0] - started
        time.sleep(0.02)
    raise AssertionError(f"{process.title} has printed nothing since:\n{process.output()[-3000:]}")


@pytest.mark.smoke
@each_way_in_turn("publisher", "subscriber")
def test_messages_flow_again_after_the_proxy_was_killed(
    lab: Lab, publisher: str, subscriber: str, source: str, sink: str, measure: Measure
) -> None:
    topic = f"/{lab.unique('topic')}"
    name = lab.unique("talker")
    sender = lab.node(publisher, source, "pub", name=name, topic=topic, rate=100)
    receiver = lab.node(subscriber, sink, "sub", topic=topic)
    receiver.wait_for_count("^got ", 5)
    uri = lab.node_uri(name)
    started = restart_proxy(lab)
    measure(
        f"messages {SIDES[source]} to {SIDES[sink]} again, proxy restarted",
        next_time(receiver, "^got ", started),
    )
    assert lab.node_uri(name) == uri
    late = lab.node(subscriber, sink, "sub", topic=topic)
    late.wait_for_count("^got ", 5, HARD_LIMIT)
    assert sender.returncode is None


@pytest.mark.smoke
@each_way_in_turn("server", "client")
def test_calls_are_answered_again_after_the_proxy_was_killed(
    lab: Lab, server: str, client: str, source: str, sink: str, measure: Measure
) -> None:
    service = f"/{lab.unique('service')}"
    lab.node(server, source, "serve", service=service)
    caller = lab.node(client, sink, "call", service=service, rate=50, count=100000)
    caller.wait_for_count("^reply ", 5)
    started = restart_proxy(lab)
    measure(
        f"calls {SIDES[sink]} to {SIDES[source]} again, proxy restarted",
        next_time(caller, "^reply ", started),
    )
    late = lab.node(client, sink, "call", service=service)
    late.wait_for("^reply ", HARD_LIMIT)


@each_pair("publisher", "subscriber")
def test_subscribers_from_before_hear_publishers_from_after(
    lab: Lab, publisher: str, subscriber: str
) -> None:
    """The master's publisherUpdate reaches inside nodes through the restarted proxy."""
    topic = f"/{lab.unique('topic')}"
    receivers = [lab.node(subscriber, role, "sub", topic=topic) for role in ("c1", "out")]
    for receiver in receivers:
        receiver.wait_for("^ready")
    restart_proxy(lab)
    for role in ("c1", "out"):
        lab.node(publisher, role, "pub", topic=topic, word=f"from-{role}")
    for receiver in receivers:
        for role in ("c1", "out"):
            receiver.wait_for_count(f"^got from-{role} ", 3, HARD_LIMIT)


@each_library
def test_nodes_keep_their_ports_and_can_be_ended_after_a_restart(lab: Lab, library: str) -> None:
    names = [lab.unique("kept") for _ in range(4)]
    nodes = [
        lab.node(library, role, "pub", name=name, topic=f"/{name}/topic")
        for name, role in zip(names, ("c1", "c1", "c2", "c2"), strict=True)
    ]
    for name in names:
        lab.wait_registered(name)
    before = {name: lab.node_uri(name) for name in names}
    restart_proxy(lab)
    assert lab.proxy is not None
    lab.proxy.wait_for(r"recovered 4 nodes")  # a port refuses until its node is confirmed
    assert {name: lab.node_uri(name) for name in names} == before
    for name, node in zip(names, nodes, strict=True):
        assert f"Pid: {node.pid}" in lab.run("out", "rosnode", "info", name).output
    lab.run("out", "rosnode", "kill", *names[:2])
    for node in nodes[:2]:
        node.wait(timeout=60)
    for node in nodes[2:]:
        assert node.stop() == 0
    for name in names:
        lab.wait_unregistered(name)


def test_a_new_node_after_a_restart_gets_a_port_of_its_own(lab: Lab) -> None:
    names = [lab.unique("port") for _ in range(3)]
    for name in names[:2]:
        lab.node("roscpp", "c1", "pub", name=name, topic=f"/{name}/topic", word=name)
        lab.wait_registered(name)
    restart_proxy(lab)
    lab.node("roscpp", "c1", "pub", name=names[2], topic=f"/{names[2]}/topic", word=names[2])
    lab.wait_registered(names[2])
    assert len({lab.node_uri(name) for name in names}) == 3
    for name in names:
        receiver = lab.node("roscpp", "out", "sub", topic=f"/{name}/topic")
        receiver.wait_for_count(f"^got {name} ", 3)


def test_a_node_that_died_while_the_proxy_was_away_is_not_served(lab: Lab) -> None:
    name = lab.unique("gone")
    node = lab.node("roscpp", "c1", "pub", name=name, topic=f"/{name}/topic")
    lab.wait_registered(name)
    assert lab.proxy is not None
    lab.proxy.kill()
    node.kill()
    lab.start_proxy()
    output = lab.run("out", "sh", "-c", "yes | rosnode cleanup").output
    assert f" * /{name}\n" in output
    assert not lab.registered(name)


@each_library
def test_nodes_that_start_while_the_proxy_is_away_are_there_when_it_is_back(
    lab: Lab, library: str
) -> None:
    topic = f"/{lab.unique('waiting')}"
    assert lab.proxy is not None
    lab.proxy.kill()
    receiver = lab.node(library, "c1", "sub", topic=topic)
    sender = lab.node(library, "out", "pub", topic=topic)
    sender.wait_for("^sent ")
    lab.start_proxy()
    receiver.wait_for_count("^got ", 3)


@each_library
def test_a_proxy_ended_by_sigterm_is_followed_by_another(lab: Lab, library: str) -> None:
    """An upgrade: the old proxy ends cleanly and removes no registration."""
    name = lab.unique("kept")
    sender = lab.node(library, "c1", "pub", name=name, topic=f"/{name}/topic")
    receiver = lab.node(library, "out", "sub", topic=f"/{name}/topic")
    receiver.wait_for("^got ")
    uri = lab.node_uri(name)
    assert lab.proxy is not None
    assert lab.proxy.stop(signal.SIGTERM) == 0
    assert lab.node_uri(name) == uri
    lab.start_proxy()
    receiver.wait_for_count("^got ", 5, since=receiver.mark())
    assert lab.node_uri(name) == uri
    assert sender.returncode is None


@each_library
def test_inside_nodes_are_registered_again_after_roscore_was_killed(
    lab: Lab, library: str, measure: Measure
) -> None:
    stem = lab.unique("again")
    names = {role: f"{stem}_{role}" for role in ("pub", "sub", "serve")}
    lab.node(library, "c1", "pub", name=names["pub"], topic=f"/{stem}/from")
    receiver = lab.node(library, "c1", "sub", name=names["sub"], topic=f"/{stem}/to")
    lab.node(library, "c2", "serve", name=names["serve"], service=f"/{stem}/s")
    for name in names.values():
        lab.wait_registered(name)
    before = {name: lab.node_uri(name) for name in names.values()}
    answered = restart_master(lab)
    for name in names.values():
        lab.wait_registered(name, HARD_LIMIT)
    measure("registered again, roscore restarted", time.time() - answered)
    assert {name: lab.node_uri(name) for name in names.values()} == before
    for peer in LIBRARIES:
        lab.node(peer, "out", "sub", topic=f"/{stem}/from").wait_for_count("^got ", 3)
        lab.node(peer, "out", "call", service=f"/{stem}/s").wait_for("^reply ")
        lab.node(peer, "out", "pub", topic=f"/{stem}/to", word=f"new-{peer}")
        receiver.wait_for_count(f"^got new-{peer} ", 3)


@pytest.mark.parametrize("restart", [restart_proxy, restart_master], ids=["proxy", "roscore"])
def test_a_subscribed_parameter_is_updated_after_a_restart(
    lab: Lab, restart: Callable[[Lab], float]
) -> None:
    name = lab.unique("watcher")
    lab.ask_master("setParam", f"/{name}/key", "before")
    watcher = lab.node("roscpp", "c1", "watchparam", name=name, key=f"/{name}/key")
    watcher.wait_for("^param before$")
    restart(lab)
    lab.wait_registered(name, HARD_LIMIT)
    # Updates are lost while the node's port is not served, as without a proxy.
    lab.run("out", "rosnode", "ping", "-c", "1", name)
    lab.ask_master("setParam", f"/{name}/key", "after")
    watcher.wait_for("^param after$", HARD_LIMIT)


@each_library
def test_inside_nodes_hear_each_other_all_the_time_while_roscore_is_away(
    lab: Lab, library: str
) -> None:
    topic = f"/{lab.unique('topic')}"
    lab.node(library, "c1", "pub", topic=topic)
    receiver = lab.node(library, "c2", "sub", topic=topic)
    receiver.wait_for_count("^got ", 3)
    assert lab.master is not None
    lab.master.kill()
    receiver.wait_for_count("^got ", 10, since=receiver.mark())
    lab.start_master()
    receiver.wait_for_count("^got ", 10, since=receiver.mark())


@each_library
def test_roscore_and_proxy_restarted_one_after_the_other(lab: Lab, library: str) -> None:
    name = lab.unique("survivor")
    lab.node(library, "c1", "pub", name=name, topic=f"/{name}/topic")
    lab.wait_registered(name)
    restart_master(lab)
    lab.wait_registered(name, HARD_LIMIT)
    restart_proxy(lab)
    lab.node(library, "out", "sub", topic=f"/{name}/topic").wait_for_count("^got ", 3)


@each_library
def test_everything_started_before_roscore(lab: Lab, library: str) -> None:
    """The proxy starts without a master. Nodes wait for the master, as without a proxy."""
    assert lab.master is not None
    assert lab.proxy is not None
    lab.proxy.kill()
    lab.master.kill()
    lab.start_proxy()
    topic = f"/{lab.unique('early')}"
    lab.node(library, "c1", "pub", topic=topic)
    receiver = lab.node(library, "out", "sub", topic=topic)
    lab.start_master()
    receiver.wait_for_count("^got ", 3)
