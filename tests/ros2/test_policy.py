"""Policy: the other side does not see denied names. A change requires no restart."""

from __future__ import annotations

import pytest

from tests.ros.processes import Process, wait_until
from tests.ros2.lab import Lab
from tests.ros2.machines import PORTS

PEER = (
    "<CycloneDDS><Domain><Discovery><Peers>"
    f'<Peer address="10.77.0.1:{PORTS.first}"/>'
    "</Peers></Discovery></Domain></CycloneDDS>"
)
"""Without it, Cyclone DDS outside does not find the proxy: Cyclone DDS has no well-known ports."""


def rules(lab: Lab, *texts: str) -> None:
    """Write the policy's file, which the proxy reads again by itself."""
    (lab.folder / "rules").write_text("\n".join(texts) + "\n")


@pytest.fixture
def lab(lab: Lab) -> Lab:
    """A proxy with a file of rules that is empty so far."""
    lab.stop()
    rules(lab, "# nothing yet")
    lab.options = (*lab.options, "--policy-file", str(lab.folder / "rules"))
    lab.start_proxy()
    return lab


def gets(reader: Process, count: int = 5) -> None:
    """Wait until the node gets ``count`` more messages or replies."""
    reader.wait_for_count("^(got|reply)", count, since=reader.mark())


def gets_nothing(reader: Process, meanwhile: Process) -> None:
    """Check that a subscriber gets no messages while another does."""
    gets(meanwhile, 3)  # messages on the way
    mark = reader.mark()
    gets(meanwhile, 20)
    assert not [line for line in reader.output()[mark:].splitlines() if line.startswith("got")]


def hidden(lab: Lab) -> set[tuple[str, str]]:
    policy = lab.status().policy
    assert policy is not None
    return {(name_status.kind, name_status.name) for name_status in policy.hidden}


@pytest.mark.parametrize(
    ("source", "sink", "kind"), [("c1", "out", "publish"), ("out", "c1", "subscribe")]
)
@pytest.mark.parametrize(("inside", "outside"), [("jazzy", "kilted"), ("cyclone", "jazzy")])
def test_a_topic_is_denied_and_allowed_again(
    lab: Lab, inside: str, outside: str, source: str, sink: str, kind: str
) -> None:
    vendors = {"c1": inside, "out": outside}
    for topic in ("/secret", "/open"):
        lab.node(vendors[source], source, "pub", topic=topic)
    secret = lab.node(vendors[sink], sink, "sub", topic="/secret")
    public = lab.node(vendors[sink], sink, "sub", topic="/open")
    gets(secret)
    gets(public)
    rules(lab, f"deny {kind} /secret")
    wait_until("the topic is hidden", lambda: (kind, "/secret") in hidden(lab), 10)
    gets_nothing(secret, public)
    rules(lab, "# allowed again")
    gets(secret)
    gets(public)


def test_a_service_is_denied_from_the_start(lab: Lab) -> None:
    rules(lab, "deny serve /secret")
    lab.node("jazzy", "c1", "serve", topic="/secret")
    lab.node("jazzy", "c1", "serve", topic="/open")
    asking = lab.node("jazzy", "out", "call", topic="/secret")
    gets(lab.node("jazzy", "out", "call", topic="/open"))
    gets(lab.node("jazzy", "c2", "call", topic="/secret"))
    assert "reply" not in asking.output()


@pytest.mark.parametrize(
    ("inside", "outside", "size"),
    [("cyclone", "jazzy", 6000), ("jazzy", "cyclone", 6000), ("cyclone", "cyclone", 50_000)],
)
@pytest.mark.parametrize(("source", "sink"), [("c1", "out"), ("out", "c1")])
def test_announcements_in_fragments_are_read(
    lab: Lab, source: str, sink: str, inside: str, outside: str, size: int
) -> None:
    """Cyclone DDS sends what is longer than 1,344 bytes in several datagrams."""
    kind = "publish" if source == "c1" else "subscribe"
    rules(lab, f"deny {kind} /secret")
    vendors = {"c1": inside, "out": outside}
    long = {role: {"user_data": size} for role in vendors if vendors[role] == "cyclone"}

    def start(role: str, kind: str, topic: str) -> Process:
        env = {"CYCLONEDDS_URI": PEER} if role == "out" else None
        return lab.node(vendors[role], role, kind, topic=topic, env=env, **long.get(role, {}))

    for topic in ("/secret", "/open"):
        start(source, "pub", topic)
    secret = start(sink, "sub", "/secret")
    public = start(sink, "sub", "/open")
    gets(public, 20)
    assert "got" not in secret.output()

    def told() -> set[str]:
        inside = lab.domain().inside
        return {name for p in inside for name in (*p.publishes, *p.subscribes)}

    # The proxy itself asks again for a fragment that was lost.
    wait_until("the proxy knows both", lambda: told() >= {"/secret", "/open"})
    rules(lab, "# allowed again")
    gets(secret)
    gets(public)
