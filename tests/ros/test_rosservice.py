"""Every subcommand of rosservice, run inside and outside, about services of either side."""

from __future__ import annotations

import re

from tests.ros.combinations import each_side, each_view, each_view_of_a_library
from tests.ros.lab import Lab


def server(lab: Lab, machine: str, library: str = "roscpp") -> tuple[str, str]:
    """Starts a server. Returns the names of node and service."""
    name = lab.unique("server")
    service = f"/{name}/echo"
    lab.node(library, machine, "serve", name=name, service=service).wait_for("^ready")
    return f"/{name}", service


@each_side
def test_list_find_and_node(lab: Lab, side: str) -> None:
    servers = [server(lab, machine) for machine in ("c1", "out")]
    listed = lab.run(side, "rosservice", "list").output.split()
    with_nodes = lab.run(side, "rosservice", "list", "-n").output
    found_services = lab.run(side, "rosservice", "find", "topic_tools/MuxSelect").output.split()
    for name, service in servers:
        assert service in listed
        assert service in found_services
        assert f"{service} {name}\n" in with_nodes
        assert lab.run(side, "rosservice", "node", service).output == f"{name}\n"


@each_view_of_a_library
def test_info_type_args_and_uri(lab: Lab, library: str, side: str, machine: str) -> None:
    name, service = server(lab, machine, library)
    info = lab.run(side, "rosservice", "info", service).output
    assert f"Node: {name}\n" in info
    assert re.search(r"^URI: rosrpc://\S+:\d+$", info, re.MULTILINE), info
    assert "Type: topic_tools/MuxSelect\nArgs: topic\n" in info
    assert lab.run(side, "rosservice", "type", service).output == "topic_tools/MuxSelect\n"
    assert lab.run(side, "rosservice", "args", service).output == "topic\n"
    uri = lab.run(side, "rosservice", "uri", service).output
    assert re.fullmatch(r"rosrpc://\S+:\d+\n", uri)
    assert f"URI: {uri}" in info


@each_view_of_a_library
def test_call_prints_the_answer(lab: Lab, library: str, side: str, machine: str) -> None:
    _, service = server(lab, machine, library)
    output = lab.run(side, "rosservice", "call", service, "tool 7 x").output
    assert output == 'prev_topic: "echo tool 7 x"\n'


@each_view
def test_list_works_for_the_services_that_every_node_has(lab: Lab, side: str, machine: str) -> None:
    name, _ = server(lab, machine, "rospy")
    assert f"{name}/get_loggers" in lab.run(side, "rosservice", "list", name).output.split()
    loggers = lab.run(side, "rosservice", "call", f"{name}/get_loggers").output
    assert 'name: "rosout"' in loggers
