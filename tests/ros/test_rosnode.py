"""Every subcommand of rosnode, run inside and outside, about nodes on either side."""

from __future__ import annotations

import re

from tests.ros.combinations import each_library, each_side, each_view_of_a_library
from tests.ros.lab import Lab
from tests.ros.processes import Process


def talker(lab: Lab, library: str, machine: str) -> tuple[Process, str]:
    """A registered publisher, and the node's name."""
    name = lab.unique("talker")
    node = lab.node(library, machine, "pub", name=name, topic=f"/{name}_topic", rate=5)
    node.wait_for("^sent ")
    return node, f"/{name}"


@each_side
def test_list_names_the_nodes_of_both_sides(lab: Lab, side: str) -> None:
    names = {talker(lab, "roscpp", machine)[1] for machine in ("c1", "out")}
    assert names <= set(lab.run(side, "rosnode", "list").output.split())
    with_uris = lab.run(side, "rosnode", "list", "-a").output
    for name in names:
        assert re.search(rf"^http://\S+:\d+/\S*\s+{name}$", with_uris, re.MULTILINE), with_uris


@each_view_of_a_library
def test_info_reaches_the_node(lab: Lab, library: str, side: str, machine: str) -> None:
    node, name = talker(lab, library, machine)
    output = lab.run(side, "rosnode", "info", name).output
    assert f"Pid: {node.pid}" in output
    assert f"* {name}_topic [std_msgs/String]" in output
    assert f"* {name}/set_logger_level" in output
    assert "ERROR" not in output


@each_side
@each_library
def test_info_shows_connections_across_the_boundary(lab: Lab, library: str, side: str) -> None:
    _, name = talker(lab, library, "c1")
    listener = lab.node(library, "out", "sub", name=lab.unique("listener"), topic=f"{name}_topic")
    listener.wait_for("^got ")
    output = lab.run(side, "rosnode", "info", name).output
    assert re.search(rf"topic: {name}_topic\s+\* to: /listener_\d+", output), output
    assert "transport: TCPROS" in output


@each_view_of_a_library
def test_ping_is_answered(lab: Lab, library: str, side: str, machine: str) -> None:
    _, name = talker(lab, library, machine)
    output = lab.run(side, "rosnode", "ping", "-c", "2", name).output
    assert len(re.findall(r"^xmlrpc reply from http://\S+\s+time=", output, re.MULTILINE)) == 2


@each_side
def test_ping_all_reaches_every_node(lab: Lab, side: str) -> None:
    names = [talker(lab, "roscpp", machine)[1] for machine in ("c1", "c2", "out")]
    output = lab.run(side, "rosnode", "ping", "--all").output
    for name in names:
        assert re.search(rf"pinging {name} with", output) or name in output
    assert "unable to ping" not in output
    assert "connection to" not in output


@each_view_of_a_library
def test_kill_ends_the_node(lab: Lab, library: str, side: str, machine: str) -> None:
    node, name = talker(lab, library, machine)
    output = lab.run(side, "rosnode", "kill", name).output
    assert f"killing {name}" in output
    assert "killed" in output
    node.wait(timeout=60)
    lab.wait_unregistered(name)


@each_side
def test_machine_lists_the_hosts_and_their_nodes(lab: Lab, side: str) -> None:
    names = {machine: talker(lab, "roscpp", machine)[1] for machine in ("c1", "out")}
    machines = lab.run(side, "rosnode", "machine").output.split()
    nodes_by_machine = {m: lab.run(side, "rosnode", "machine", m).output.split() for m in machines}
    for name in names.values():
        assert any(name in nodes for nodes in nodes_by_machine.values()), nodes_by_machine


@each_view_of_a_library
def test_cleanup_removes_a_killed_node(lab: Lab, library: str, side: str, machine: str) -> None:
    node, name = talker(lab, library, machine)
    _, living = talker(lab, "roscpp", "c1")
    node.kill()
    output = lab.run(side, "sh", "-c", "yes | rosnode cleanup").output
    assert f" * {name}\n" in output
    assert living not in output
    assert not lab.registered(name)
    assert lab.registered(living)
