"""Messages go both ways between each library and rospy and roscpp, as without the proxy."""

from __future__ import annotations

from tests.clients.matrix import PEERS, each_client
from tests.ros.lab import Lab


@each_client()
def test_what_a_node_publishes_is_heard(lab: Lab, library: str, side: str, across: str) -> None:
    topic = f"/{lab.unique('out')}"
    sender = lab.node(library, side, "pub", topic=topic, rate=50)
    for receiver in [lab.node(peer, across, "sub", topic=topic) for peer in PEERS]:
        got = receiver.wait_for_count(r"^got hello (\d+) size (\d+ crc \w+)", 10)
        numbers = [int(match[1]) for match in got]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        sender.wait_for(f"^sent hello {got[0][1]} size {got[0][2]} ")


@each_client()
def test_a_node_hears_what_is_published(lab: Lab, library: str, side: str, across: str) -> None:
    topic = f"/{lab.unique('in')}"
    receiver = lab.node(library, side, "sub", topic=topic)
    receiver.wait_for("^ready")
    for peer in PEERS:
        sender = lab.node(peer, across, "pub", topic=topic, word=f"from-{peer}")
        got = receiver.wait_for_count(rf"^got (from-{peer} \d+ size \d+ crc \w+)", 5)
        sender.wait_for(f"^sent {got[0][1]} ")


@each_client()
def test_a_node_hears_who_was_there_before(lab: Lab, library: str, side: str, across: str) -> None:
    topic = f"/{lab.unique('before')}"
    for peer in PEERS:
        lab.node(peer, across, "pub", topic=topic, word=f"from-{peer}").wait_for("^sent ")
    receiver = lab.node(library, side, "sub", topic=topic)
    for peer in PEERS:
        receiver.wait_for_count(f"^got from-{peer} ", 3)


@each_client()
def test_the_doctor_finds_the_pairs_connected(
    lab: Lab, library: str, side: str, across: str
) -> None:
    """Publishers of rosnodejs and foxglove name no subscribers, and were told as not connected."""
    topics = [f"/{lab.unique('doctor')}" for _ in ("out", "in")]
    lab.node(library, side, "pub", topic=topics[0])
    lab.node("rospy", across, "sub", topic=topics[0]).wait_for("^got hello ")
    receiver = lab.node(library, side, "sub", topic=topics[1])
    lab.node("roscpp", across, "pub", topic=topics[1])
    receiver.wait_for("^got hello ")
    for topic in topics:
        report = lab.rosproxy("doctor", topic).output
        assert "connected" in report
        assert "not connected" not in report
