"""QoS policies hold across the boundary, and violations are reported.

Readers measure deadlines. Discovery messages carry liveliness.
"""

from __future__ import annotations

import pytest

from tests.ros2.lab import Lab

ways = pytest.mark.parametrize(
    ("source", "sink"), [("c1", "out"), ("out", "c1")], ids=["outward", "inward"]
)
LEASE = 3.0


@ways
def test_deadline(lab: Lab, source: str, sink: str) -> None:
    writer = lab.node("jazzy", source, "pub", topic="/imu", deadline=2, count=30)
    reader = lab.node("jazzy", sink, "sub", topic="/imu", deadline=2)
    strict = lab.node("jazzy", sink, "sub", topic="/imu", deadline=0.01)
    reader.wait_for("^deadline missed 1")
    assert "got hello 29 " in reader.output(), "missed before the last message"
    writer.wait_for("^offered deadline missed 1")
    for node in (writer, strict):
        node.wait_for("^incompatible deadline")
    assert "got" not in strict.output()


@ways
def test_liveliness(lab: Lab, source: str, sink: str) -> None:
    options = {"topic": "/arm", "liveliness": "AUTOMATIC", "lease": LEASE}
    writer = lab.node("jazzy", source, "pub", count=1, **options)
    reader = lab.node("jazzy", sink, "sub", **options)
    manual = {"topic": "/leg", "liveliness": "MANUAL_BY_TOPIC", "lease": LEASE}
    silent = lab.node("jazzy", source, "pub", count=10, matched=True, **manual)
    listener = lab.node("jazzy", sink, "sub", **manual)
    for subscriber in (reader, listener):
        subscriber.wait_for("^alive 1 not 0")
    listener.wait_for("^alive 0 not 1")
    silent.wait_for("^liveliness lost 1")
    assert silent.returncode is None
    # The other node has published nothing for longer. Its participant asserts liveliness by itself.
    assert "alive 0" not in reader.output()
    writer.kill()
    reader.wait_for("^alive 0 not 1")
