"""Nodes start in any order, hang, crash and come back. The proxy starts in between or last."""

from __future__ import annotations

import signal
import socket
from pathlib import Path

import pytest

from rosproxy.ros2.protocol.announcement import dispose_message
from rosproxy.ros2.protocol.rtps import FAST_DDS
from tests.ros.processes import wait_until
from tests.ros2.lab import Lab, is_whole

ways = pytest.mark.parametrize(
    ("source", "sink"), [("c1", "out"), ("out", "c1")], ids=["outward", "inward"]
)
SHORT_LEASE = """<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <participant profile_name="default" is_default_profile="true">
    <rtps><builtin><discovery_config>
      <leaseDuration><sec>5</sec></leaseDuration>
      <leaseAnnouncement><sec>1</sec></leaseAnnouncement>
    </discovery_config></builtin></rtps>
  </participant>
</profiles>"""
"""For Fast DDS, instead of the default 20 and 3 seconds."""


@pytest.mark.parametrize(
    "order", [("c1", "px", "out"), ("out", "px", "c1"), ("c1", "out", "px")], ids="-".join
)
def test_any_order(lab: Lab, order: tuple[str, ...]) -> None:
    assert lab.proxy is not None
    lab.proxy.kill()
    nodes = {}
    for role in order:
        if role == "px":
            lab.start_proxy()
            continue
        other = "out" if role == "c1" else "c1"
        kinds = "pub,sub,serve" if role == "c1" else "pub,sub,call"
        nodes[other] = lab.node("jazzy", role, kinds, topic="/talk", word=f"from-{role}")
        nodes[other].wait_for("^sent 5")
    for other, node in nodes.items():
        node.wait_for_count(f"^got from-{other} ", 5)
    nodes["c1"].wait_for_count("^reply .* from-c1", 5)


@ways
def test_a_subscriber_that_hangs_misses_nothing(lab: Lab, source: str, sink: str) -> None:
    writer = lab.node("jazzy", source, "pub", topic="/chatter", depth=1000)
    reader = lab.node("jazzy", sink, "sub", topic="/chatter", depth=1000)
    reader.wait_for_count("^got hello ", 5)
    reader.send(signal.SIGSTOP)
    writer.wait_for_count("^sent ", 30, since=writer.mark())
    reader.send(signal.SIGCONT)
    reader.wait_for_count("^got hello ", 40)
    assert is_whole(reader), "messages were lost"


def test_participants_that_hang_until_they_count_as_gone_go_on(lab: Lab, tmp_path: Path) -> None:
    profile = tmp_path / "profile.xml"
    profile.write_text(SHORT_LEASE)
    env = {"FASTRTPS_DEFAULT_PROFILES_FILE": str(profile)}
    nodes = {}
    for role in ("c1", "c2", "out"):
        options = {"topic": "/talk", "word": f"from-{role}"}
        nodes[role] = lab.node("jazzy", role, "pub,sub", env=env, **options)

    def all_hear(inside: str) -> None:
        nodes["out"].wait_for_count(f"^got from-{inside} ", 5, since=nodes["out"].mark())
        nodes[inside].wait_for_count("^got from-out ", 5, since=nodes[inside].mark())

    for inside in ("c1", "c2"):
        all_hear(inside)
    for role, counts in (("c1", (1, 1)), ("out", (2, 0))):
        nodes[role].send(signal.SIGSTOP)
        lab.wait_for_participants(*counts)
        nodes[role].send(signal.SIGCONT)
        for inside in ("c1", "c2"):
            all_hear(inside)


@ways
def test_a_server_that_crashed_is_called_again(lab: Lab, source: str, sink: str) -> None:
    caller = lab.node("jazzy", sink, "call", topic="/add")
    for number in range(3):
        server = lab.node("jazzy", source, "serve", name="adder", topic="/add", word=f"no-{number}")
        caller.wait_for_count(f"^reply .* no-{number}", 5)
        server.kill()


def test_a_node_that_ends_is_gone_on_the_other_side(lab: Lab) -> None:
    inside = lab.node("jazzy", "c1", "names", name="inside", period=0.2)
    outside = lab.node("jazzy", "out", "names", name="outside", period=0.2)
    for node in (inside, outside):
        node.wait_for("^nodes inside outside end$")
    later = lab.node("jazzy", "out", "names", name="later", period=0.2)
    inside.wait_for("^nodes inside later outside end$")
    later.stop()
    inside.wait_for("^nodes inside outside end$", since=inside.mark())
    inside.stop()
    outside.wait_for("^nodes outside end$", since=outside.mark())
    wait_until("the ports are free", lambda: lab.domain().ports_used == 0, 20)


@ways
def test_a_forged_end_is_no_end_for_good(lab: Lab, source: str, sink: str) -> None:
    """A container with the right for raw packets sends a dispose message from another container's
    address. Its sequence number is greater than the numbers of the following announcements.
    """
    lab.node("jazzy", source, "pub", topic="/chatter", depth=1000)
    reader = lab.node("jazzy", sink, "sub", topic="/chatter", depth=1000)
    reader.wait_for_count("^got hello ", 5)
    (participant,) = lab.domain().inside
    prefix = bytes.fromhex(participant.guid_prefix.replace(".", ""))
    with lab.place("c1").entered(), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.sendto(dispose_message(prefix, FAST_DDS, 1000), (lab.place("px").address, 7410))
    wait_until("the participant has ended", lambda: not lab.domain().inside)
    reader.wait_for_count("^got hello ", 20, since=reader.mark())
