"""`rosproxy doctor` reports setups that cannot work, with the participants and the fix."""

from __future__ import annotations

import pytest

from rosproxy.doctor.rules.participant import SETTLED_AFTER_S
from rosproxy.shared.addresses import HostPort
from tests.ros.processes import wait_until
from tests.ros.topology import run_command
from tests.ros2.lab import Lab
from tests.ros2.machines import PORTS

BAD_QOS = pytest.mark.parametrize(
    ("policy", "offer", "request_"),
    [
        ("reliability", {"best_effort": True}, {}),
        ("durability", {}, {"latched": True}),
    ],
    ids=["reliability", "durability"],
)


def wait_for_problem(lab: Lab, subject: str, present: bool = True) -> None:
    """Wait until the proxy tells of a problem by itself, or no more."""

    def told() -> bool:
        return any(problem.subject == subject for problem in lab.status().problems) is present

    wait_until(f"a problem of {subject}: {present}", told, 60)


def wait_shown(lab: Lab, topic: str, state: str, text: str = "") -> None:
    """Wait until the live page has a link so, and why."""

    def is_shown() -> bool:
        shown = [link for link in lab.page()["links"].values() if link["name"] == topic]
        return any(link["state"] == state and text in link.get("text", "") for link in shown)

    wait_until(f"the page shows {topic}: {state}", is_shown)


def doctor_of_networks(lab: Lab) -> str:
    """The doctor's output once the proxy has settled. Before, the doctor reports no
    participants.
    """
    wait_until("the proxy has settled", lambda: lab.status().uptime > SETTLED_AFTER_S, 30)
    return " ".join(lab.tool("doctor").split())


def line(text: str, start: str) -> str:
    """The finding with this beginning, in a single line with the fix."""
    shown = " ".join(text.split())
    findings = [finding for finding in shown.split("ERROR ") if finding.startswith(start)]
    assert findings, text
    return findings[0]


@BAD_QOS
@pytest.mark.parametrize(
    ("source", "sink"), [("c1", "out"), ("out", "c1")], ids=["outward", "inward"]
)
def test_qos_that_does_not_match(
    lab: Lab,
    policy: str,
    offer: dict[str, object],
    request_: dict[str, object],
    source: str,
    sink: str,
) -> None:
    lab.node("jazzy", source, "pub", topic="/scan", **offer)
    reader = lab.node("jazzy", sink, "sub", topic="/scan", **request_)
    wait_for_problem(lab, "topic /scan")
    told = line(lab.tool("doctor", fails=True), f"topic /scan: {policy} differs")
    domain = lab.domain()
    for participant in (*domain.inside, *domain.outside):
        assert f"{participant.guid_prefix} at {participant.address} (Fast DDS," in told
    assert "> " in told
    assert "got hello" not in reader.output()
    wait_shown(lab, "/scan", "broken", policy)

    reader.stop()
    wait_for_problem(lab, "topic /scan", present=False)
    lab.node("jazzy", sink, "sub", topic="/scan", **offer).wait_for_count("^got hello ", 5)
    assert "Nothing wrong was found." in lab.tool("doctor")
    wait_shown(lab, "/scan", "ok")


def test_types_that_differ(lab: Lab) -> None:
    lab.node("jazzy", "out", "pub", topic="/chatter")
    lab.node("cyclone", "c1", "sub", topic="/rosout")
    wait_for_problem(lab, "topic /rosout")
    told = line(lab.tool("doctor", "/rosout", fails=True), "topic /rosout: type differs")
    assert "offers rcl_interfaces/msg/Log" in told
    assert "requests std_msgs/msg/String" in told


def test_who_matches_is_told_of_a_topic(lab: Lab) -> None:
    lab.node("jazzy", "c1", "pub", topic="/chatter")
    lab.node("jazzy", "out", "sub", topic="/chatter").wait_for_count("^got hello ", 5)
    told = " ".join(lab.tool("doctor", "chatter").split())
    assert f"at {lab.place('out').address} (Fast DDS, outside) match" in told
    assert "Nothing wrong was found." in told
    assert "no participant has" in lab.tool("doctor", "/chater", fails=True)


@pytest.mark.parametrize("vendor", ["jazzy", "kilted"])
def test_a_discovery_range_of_one_machine(lab: Lab, vendor: str) -> None:
    env = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    lab.node(vendor, "c1", "pub", topic="/chatter", env=env).wait_for("^sent")
    told = doctor_of_networks(lab)
    assert (
        f"at {lab.place('c1').address} (Fast DDS, inside): answers the doctor, but does not" in told
    )
    assert "ROS_STATIC_PEERS" in told

    # Follow the fix: the range stays, and the proxy is a peer.
    env["ROS_STATIC_PEERS"] = lab.place("px").address
    lab.node(vendor, "c2", "pub", topic="/chatter", env=env)
    lab.node(vendor, "out", "sub", topic="/chatter").wait_for_count("^got hello ", 5)
    assert lab.place("c2").address in {participant.address for participant in lab.domain().inside}


def test_another_domain(lab: Lab) -> None:
    lab.node("jazzy", "c1", "pub", topic="/chatter", env={"ROS_DOMAIN_ID": "5"}).wait_for("^sent")
    lab.node("kilted", "c2", "pub", topic="/chatter", env={"ROS_DOMAIN_ID": "7"}).wait_for("^sent")
    told = doctor_of_networks(lab)
    for role, domain in (("c1", 5), ("c2", 7)):
        assert f"at {lab.place(role).address} (Fast DDS, inside): is in domain {domain}," in told
    assert "set ROS_DOMAIN_ID=0 for the participant, or set --ros2-domain 5" in told


def test_tcp(lab: Lab) -> None:
    env = {"FASTDDS_BUILTIN_TRANSPORTS": "LARGE_DATA"}
    lab.node("jazzy", "c1", "pub", topic="/chatter", env=env).wait_for("^sent")
    lab.wait_for_participants(1, 0)
    (participant,) = lab.domain().inside
    wait_for_problem(lab, participant.guid_prefix)
    told = line(lab.tool("doctor", fails=True), participant.guid_prefix)
    assert f"at {participant.address} (Fast DDS, inside): receives by TCP only" in told
    assert "unset FASTDDS_BUILTIN_TRANSPORTS" in told


def test_a_peer_that_does_not_get_in(lab: Lab) -> None:
    """The peer reaches the first port of the range, and a firewall drops datagrams to the
    others.
    """
    host = ("ip", "netns", "exec", lab.place("host").namespace, "nft")
    rule = f"udp dport {{ {PORTS.first + 1}-{PORTS.last} }} drop"
    run_command(*host, "-f", "-", text=f"""
        table ip firewall {{
          chain before {{ type filter hook prerouting priority raw; iifname "out0" {rule} ; }}
        }}""")  # fmt: skip
    try:
        lab.node("jazzy", "c1", "pub", topic="/chatter")
        reader = lab.node("jazzy", "out", "sub", topic="/chatter")
        lab.wait_for_participants(1, 1)
        (participant,) = lab.domain().outside
        wait_for_problem(lab, participant.guid_prefix)
        told = " ".join(lab.tool("doctor").split())
        assert f"at {participant.address} (Fast DDS, outside): no datagram from this" in told
        assert "publish the range for UDP, and let firewalls accept UDP" in told
        assert "got " not in reader.output()
    finally:
        run_command(*host, "delete", "table", "ip", "firewall")

    wait_for_problem(lab, participant.guid_prefix, present=False)
    reader.wait_for_count("^got hello ", 5)


def test_cyclone_with_ports_of_its_own(lab: Lab) -> None:
    """With multicast, as on most machines, Cyclone DDS has no well-known ports."""
    lab.node("cyclone", "out", "sub", topic="/chatter").wait_for("^ready")
    lab.node("jazzy", "c1", "pub", topic="/chatter")
    passer_by = lab.node("jazzy", "out", "sub", topic="/chatter")
    passer_by.wait_for("^got hello ")  # proves that announcements arrive there
    passer_by.stop()
    lab.wait_for_participants(1, 0)
    told = " ".join(lab.tool("doctor").split())
    peer = f'<Peer address="{HostPort(lab.host, PORTS.first)}"/>'
    assert "no participant outside has been heard" in told
    assert peer in told

    # Follow the fix.
    lab.stop_nodes()
    uri = f"<CycloneDDS><Domain><Discovery><Peers>{peer}</Peers></Discovery></Domain></CycloneDDS>"
    lab.node("jazzy", "c1", "pub", topic="/chatter")
    reader = lab.node("cyclone", "out", "sub", topic="/chatter", env={"CYCLONEDDS_URI": uri})
    reader.wait_for_count("^got hello ", 5)
