"""Nodes of each library and their peers end, are killed and come back, as without a proxy."""

from __future__ import annotations

from tests.clients.matrix import CALL, PEERS, SERVE, each_client
from tests.ros.lab import Lab
from tests.ros.processes import wait_until


@each_client()
def test_a_publisher_that_was_killed_is_heard_again(
    lab: Lab, library: str, side: str, across: str
) -> None:
    name = lab.unique("talker")
    options = {"name": name, "topic": f"/{name}/topic"}
    receivers = [lab.node(peer, across, "sub", topic=options["topic"]) for peer in PEERS]
    first = lab.node(library, side, "pub", word="first", **options)
    for receiver in receivers:
        receiver.wait_for("^got first ")
    first.kill()
    lab.node(library, side, "pub", word="second", **options)
    for receiver in receivers:
        receiver.wait_for_count("^got second ", 3)


@each_client()
def test_a_subscriber_hears_publishers_that_were_killed(
    lab: Lab, library: str, side: str, across: str
) -> None:
    for peer in PEERS:
        name = lab.unique("talker")
        options = {"name": name, "topic": f"/{name}/topic"}
        receiver = lab.node(library, side, "sub", topic=options["topic"])
        first = lab.node(peer, across, "pub", word="first", **options)
        receiver.wait_for("^got first ")
        first.kill()
        lab.node(peer, across, "pub", word="second", **options)
        receiver.wait_for_count("^got second ", 3)


@each_client(SERVE)
def test_a_server_that_was_killed_is_called_again(
    lab: Lab, library: str, side: str, across: str
) -> None:
    name = lab.unique("server")
    options = {"name": name, "service": f"/{name}/service"}
    first = lab.node(library, side, "serve", **options)
    first.wait_for("^ready")
    lab.node("rospy", across, "call", service=options["service"]).wait_for("^reply ")
    first.kill()
    second = lab.node(library, side, "serve", **options)
    second.wait_for("^ready")
    for peer in PEERS:
        lab.node(peer, across, "call", service=options["service"]).wait_for("^reply ")


@each_client(CALL)
def test_servers_that_were_killed_are_called_again(
    lab: Lab, library: str, side: str, across: str
) -> None:
    for peer in PEERS:
        name = lab.unique("server")
        options = {"name": name, "service": f"/{name}/service"}
        first = lab.node(peer, across, "serve", **options)
        caller = lab.node(library, side, "call", service=options["service"], count=100000, rate=10)
        caller.wait_for("^reply ")
        first.kill()
        lab.node(peer, across, "serve", **options).wait_for("^ready")
        caller.wait_for_count("^reply ", 3, since=caller.mark())


@each_client()
def test_a_node_that_ends_is_unregistered(lab: Lab, library: str, side: str, across: str) -> None:
    names = {kind: lab.unique(kind) for kind in ("pub", "sub")}
    for kind, name in names.items():
        node = lab.node(library, side, kind, name=name, topic=f"/{name}/topic")
        node.wait_for("^ready")
        # Foxglove's subscribes without telling when that is done.
        wait_until(f"{name} is registered", lambda name=name: lab.registered(name))
        node.stop()
        assert not lab.registered(name)
