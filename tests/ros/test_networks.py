"""Inside nodes on separate networks, a mapped port range, and a host with a name.

c1 and c2 are on two bridges that share only the proxy. The host publishes 46000-46029 to the
proxy's 45000-45029. Outside knows the host by name.
"""

from __future__ import annotations

import pytest

from tests.ros.combinations import each_direction, each_library, each_pair
from tests.ros.lab import Lab
from tests.ros.topology import ADVERTISED_NAME, SPLIT

PLAN = SPLIT
ADVERTISE_HOST = ADVERTISED_NAME


@each_direction
@each_pair("publisher", "subscriber")
def test_topics(lab: Lab, publisher: str, subscriber: str, source: str, sink: str) -> None:
    topic = f"/{lab.unique('topic')}"
    lab.node(publisher, source, "pub", topic=topic)
    lab.node(subscriber, sink, "sub", topic=topic).wait_for_count("^got hello ", 5)


@each_direction
@each_pair("server", "client")
def test_services(lab: Lab, server: str, client: str, source: str, sink: str) -> None:
    service = f"/{lab.unique('service')}"
    lab.node(server, source, "serve", service=service)
    lab.node(client, sink, "call", service=service).wait_for("^reply ask 0 ")


@each_library
def test_the_same_name_in_use_on_both_networks(lab: Lab, library: str) -> None:
    """ROS's own rule holds: the newer node ends the older node of the same name."""
    name = lab.unique("same")
    topic = f"/{lab.unique('topic')}"
    older = lab.node(library, "c1", "pub", name=name, topic=topic, word="older")
    receiver = lab.node(library, "c2", "sub", topic=topic)
    receiver.wait_for("^got older ")
    lab.node(library, "c2", "pub", name=name, topic=topic, word="newer")
    older.wait(timeout=60)
    receiver.wait_for("^got newer ")


@each_library
def test_tools_on_the_other_network(lab: Lab, library: str) -> None:
    name = lab.unique("subject")
    node = lab.node(library, "c1", "pub", name=name, topic=f"/{name}/topic")
    node.wait_for("^sent ")
    assert f"Pid: {node.pid}" in lab.run("c2", "rosnode", "info", name).output
    lab.run("c2", "rostopic", "echo", "-n", "1", f"/{name}/topic")
    lab.run("c2", "rosnode", "kill", name)
    node.wait(timeout=60)


@pytest.mark.boundary
def test_outside_sees_the_name_and_the_mapped_port(lab: Lab) -> None:
    name = lab.unique("seen")
    lab.node("roscpp", "c1", "sub", name=name, topic="/seen").wait_for("^ready")
    uri = lab.node_uri(name)
    assert uri is not None
    assert uri.startswith(f"http://{ADVERTISED_NAME}:460")
