"""Policy with real nodes: hidden outside, unchanged inside, in either mode and after restarts."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from http.client import HTTPConnection
from typing import Any
from urllib.parse import urlsplit

import pytest

from rosproxy.ros1.protocol.tcpros import decode_header, encode_header
from tests.ros import wire
from tests.ros.combinations import each_library
from tests.ros.lab import ROSCORE, Lab
from tests.ros.processes import wait_until

pytestmark = pytest.mark.boundary

MASTER = ROSCORE
PROXY_OPTIONS = ("--policy", "deny publish /hidden/*; deny serve /hidden/*")
PAIRS = pytest.mark.parametrize(
    ("first", "second"), [("rospy", "roscpp"), ("roscpp", "rospy")], ids=["rospy", "roscpp"]
)
ADMIN_PORT = 11312


@pytest.fixture(autouse=True)
def _no_rules_are_left(lab: Lab) -> Iterator[None]:
    yield
    tell(lab)


def tell(lab: Lab, *rules: str, mode: str = "enforce") -> dict[str, Any]:
    """Sends a layer of rules to the proxy. Returns the result."""
    layers = [{"name": "test", "mode": mode, "rules": list(rules), "addresses": None}]
    with lab.place("px").entered():
        connection = HTTPConnection("127.0.0.1", ADMIN_PORT, timeout=20)
        try:
            connection.request("POST", "/policy", json.dumps({"layers": layers}))
            reply = connection.getresponse()
            text = reply.read()
        finally:
            connection.close()
    assert reply.status == 200, text
    answer: dict[str, Any] = json.loads(text)
    return answer


def lease(lab: Lab, name: str) -> tuple[str, int]:
    """The address at which outside reaches a node."""
    parts = urlsplit(lab.node_uri(name) or "")
    assert parts.hostname
    assert parts.port
    return parts.hostname, parts.port


def greet(lab: Lab, name: str, **fields: str) -> dict[str, str]:
    """A node's answer to a TCPROS header from outside."""
    place = lab.place("out")
    header = {"callerid": "/spy", "md5sum": "*", **fields}
    with place.entered(), socket.create_connection(lease(lab, name), timeout=20) as conn:
        conn.sendall(encode_header(header))
        stream = conn.makefile("rb")
        return decode_header(stream.read(int.from_bytes(stream.read(4), "little")))


@pytest.mark.smoke
@PAIRS
def test_a_hidden_topic_is_heard_inside_alone(lab: Lab, first: str, second: str) -> None:
    name = lab.unique("talker")
    topic = f"/hidden/{lab.unique('topic')}"
    early = lab.node(second, "c2", "sub", topic=topic)
    early.wait_for("^ready")
    lab.node(first, "c1", "pub", name=name, topic=topic, rate=20)
    late = lab.node(first, "c2", "sub", topic=topic)
    for receiver in (early, late):
        receiver.wait_for_count("^got ", 5)
    published = lab.run("out", "rostopic", "list", "-p").output
    assert "/rosout" in published
    assert topic not in published
    assert topic in lab.run("c2", "rostopic", "list", "-p").output
    lab.run("c2", "rostopic", "echo", "-n", "1", topic)
    address = lease(lab, name)
    with pytest.raises(LookupError, match=r"deny publish /hidden/\*"):
        wire.call(lab.place("out"), *address, "requestTopic", "/spy", topic, [["TCPROS"]])
    answer = greet(lab, name, topic=topic, type="*")
    assert "deny publish /hidden/*" in answer["error"]
    assert "error" not in greet(lab, name, topic="/rosout", type="*")
    assert topic in lab.rosproxy("status").output


@PAIRS
def test_a_hidden_service_is_called_inside_alone(lab: Lab, first: str, second: str) -> None:
    name = lab.unique("server")
    service = f"/hidden/{lab.unique('service')}"
    lab.node(first, "c1", "serve", name=name, service=service).wait_for("^ready")
    caller = lab.node(second, "c2", "call", service=service, count=3, rate=50)
    caller.wait_for("^done")
    assert service not in lab.run("out", "rosservice", "list").output
    assert "deny serve /hidden/*" in greet(lab, name, service=service)["error"]


@PAIRS
def test_a_change_cuts_outside_and_leaves_inside(lab: Lab, first: str, second: str) -> None:
    name = lab.unique("talker")
    topic = f"/{name}/topic"
    lab.node(first, "c1", "pub", name=name, topic=topic, rate=50)
    outside = lab.node(second, "out", "sub", topic=topic)
    inside = lab.node(second, "c2", "sub", topic=topic)
    for receiver in (outside, inside):
        receiver.wait_for_count("^got ", 5)
    answer = tell(lab, f"deny publish {topic}")
    assert answer["hidden"] == 1
    assert answer["cut"] >= 1
    assert topic not in lab.run("out", "rostopic", "list", "-p").output
    before = outside.mark()
    heard = len(inside.wait_for_count("^got ", 1))
    inside.wait_for_count("^got ", heard + 20)
    assert "got " not in outside.output(before)
    assert tell(lab)["shown"] == 1
    wait_until("outside hears again", lambda: "got " in outside.output(before), 30)
    assert inside.returncode is None


def test_audit_changes_nothing_and_tells(lab: Lab) -> None:
    name = lab.unique("talker")
    topic = f"/{name}/topic"
    assert tell(lab, "deny publish *", "deny slave *", mode="audit")["hidden"] == 0
    lab.node("roscpp", "c1", "pub", name=name, topic=topic, rate=20)
    lab.node("rospy", "out", "sub", topic=topic).wait_for_count("^got ", 5)
    assert lab.proxy
    lab.proxy.wait_for(r"would be denied by policy of test: deny publish \*")


@each_library
def test_hidden_topics_are_known_to_a_proxy_that_was_killed(lab: Lab, library: str) -> None:
    name = lab.unique("talker")
    topic = f"/hidden/{lab.unique('topic')}"
    lab.node(library, "c1", "pub", name=name, topic=topic, rate=20)
    early = lab.node("rospy", "c2", "sub", topic=topic)
    early.wait_for_count("^got ", 5)
    lab.wait_registered(name)
    assert lab.proxy
    lab.proxy.kill()
    lab.start_proxy()
    late = lab.node("roscpp", "c2", "sub", topic=topic)
    late.wait_for_count("^got ", 5)
    mark = early.mark()
    wait_until("the early subscriber receives, too", lambda: "got " in early.output(mark), 30)
    assert topic not in lab.run("out", "rostopic", "list", "-p").output
    assert "deny publish" in greet(lab, name, topic=topic, type="*")["error"]


@each_library
def test_hidden_services_are_found_by_a_proxy_that_was_killed(lab: Lab, library: str) -> None:
    name = lab.unique("server")
    service = f"/hidden/{lab.unique('service')}"
    lab.node(library, "c1", "serve", name=name, service=service).wait_for("^ready")
    lab.wait_registered(name)
    assert lab.proxy
    lab.proxy.kill()
    lab.start_proxy()
    caller = lab.node("roscpp", "c2", "call", service=service, count=3, rate=50)
    caller.wait_for("^done")
    assert service not in lab.run("out", "rosservice", "list").output


@PAIRS
def test_what_is_denied_of_outside_is_hidden_inside(lab: Lab, first: str, second: str) -> None:
    topic = f"/{lab.unique('topic')}"
    service = f"/{lab.unique('service')}"
    tell(lab, f"deny subscribe {topic}", f"deny call {service}", "deny get-param /secret/*")
    lab.node(first, "out", "pub", topic=topic, word="far", rate=20).wait_for("^sent ")
    lab.node(first, "out", "serve", service=service).wait_for("^ready")
    receiver = lab.node(second, "c1", "sub", topic=topic)
    lab.node(first, "c2", "pub", topic=topic, word="near", rate=20)
    receiver.wait_for_count("^got near ", 5)
    assert "got far " not in receiver.output()
    called = lab.run("c1", "rosservice", "call", service, "{}", check=False)
    assert called.returncode != 0
    lab.run("out", "rosparam", "set", "/secret/key", "1")
    refused = lab.run("c1", "rosparam", "get", "/secret/key", check=False)
    assert (refused.returncode, "deny get-param" in refused.output) == (1, True)
    assert "/secret/key" not in lab.run("c1", "rosparam", "list").output
    assert "/rosdistro" in lab.run("c1", "rosparam", "list").output
