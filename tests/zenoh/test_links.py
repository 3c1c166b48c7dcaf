"""Links between sites: px with c1 and c2 is the site of a robot, the machine out is the cloud."""

from __future__ import annotations

import os
import time
from datetime import timedelta
from functools import partial
from itertools import pairwise
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric import ec

from tests import certificates
from tests.certificates import DAY, Authority
from tests.ros.processes import Process, wait_until
from tests.zenoh.lab import PORTS, ROUTER_PORT, VERSIONS, Lab

VERSION = "1.7.2"
CLOUD = "robot"
"""The host name of the machine out."""
PAST = -DAY / 24


class Sites:
    """The proxies of two sites, with a CA for both."""

    def __init__(self, lab: Lab, protocol: str = "tls") -> None:
        self.lab = lab
        self.protocol = protocol
        self.authority = Authority()
        self.volume = lab.folder / "volume"

    def files(self, name: str, *names: str, ends: timedelta = 90 * DAY) -> Path:
        """A certificate of the CA, in a folder."""
        return self.authority.write(self.lab.folder / name, *names, begins=-2 * DAY, ends=ends)

    def start_cloud(self, folder: Path | None = None, *options: str) -> Process:
        """Start the proxy of the cloud."""
        folder = folder or self.files("cloud", CLOUD)
        listen = ("--zenoh-link-listen", f"{self.protocol}/{ROUTER_PORT}")
        return self.lab.start_proxy_on("out", *listen, *written(folder), *options)

    def start_robot(self, folder: Path | None = None, *options: str) -> None:
        """Start the proxy of the robot."""
        folder = folder or self.files("client")
        link = ("--zenoh-link", f"{self.protocol}/{CLOUD}")
        self.lab.start_proxy(*link, *written(folder), *options, with_robot=False)

    def wait_for_link(self) -> None:
        self.lab.wait_for_link()

    def in_cloud(self, kind: str, topic: str = "chatter", version: str = VERSION) -> Process:
        """Start a node in the cloud."""
        override = f'connect/endpoints=["tcp/127.0.0.1:{PORTS["c1"]}"]'
        return self.lab.node(version, "out", kind, topic, ZENOH_CONFIG_OVERRIDE=override)

    def at_robot(self, kind: str, topic: str = "chatter", version: str = VERSION) -> Process:
        """Start a node at the robot."""
        return self.lab.node(version, "c1", kind, topic)


def written(folder: Path) -> list[str]:
    """The options for the files of a folder."""
    given = certificates.options(folder).items()
    return [f"--{name.replace('_', '-')}={path}" for name, path in given]


def flows(receiver: Process, line: str = "^got hello ") -> None:
    """Wait until messages or answers arrive, from now on."""
    receiver.wait_for_count(line, 3, 30, since=receiver.mark())


def messages(node: Process, mark: int = 0) -> list[int]:
    """The numbers of the messages that a subscriber has received."""
    lines = node.output(since=mark).splitlines()
    return [int(line.split()[-1]) for line in lines if line.startswith("got hello")]


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("protocol", ["tls", "quic"])
def test_messages_calls_and_the_graph_pass_a_link(lab: Lab, protocol: str, version: str) -> None:
    sites = Sites(lab, protocol)
    sites.start_cloud()
    sites.start_robot()
    sites.wait_for_link()
    graph = sites.at_robot("graph", version=version)
    to_robot = sites.at_robot("sub", "map", version)
    to_cloud = sites.in_cloud("sub", version=version)
    sites.at_robot("serve", "reset", version)
    caller = sites.in_cloud("call", "reset", version)
    sites.at_robot("pub", version=version)
    publisher = sites.in_cloud("pub", "map", version)
    flows(to_cloud)
    flows(to_robot)
    flows(caller, "^answer of ")
    graph.wait_for(f"^listed {publisher.title} MP %map$", timeout=30)
    (session,) = [s for s in lab.zenoh().sessions if s.mode == "router"]
    assert session.remote.endswith(f":{ROUTER_PORT}")
    assert not lab.status().problems


@pytest.mark.parametrize(
    ("side", "fault", "told"),
    [
        ("cloud", "foreign", "is of a CA that this proxy does not trust"),
        ("cloud", "expired", "the certificate of the other proxy, or its CA, has expired"),
        ("cloud", "name", "is for another host name"),
        ("robot", "foreign", "it is of a CA that the other proxy does not trust"),
        ("cloud", "same name", "is of a CA that this proxy does not trust"),
        ("robot", "same name", "it is of a CA that the other proxy does not trust"),
        ("robot", "expired", "refuses the certificate of this proxy as expired"),
    ],
)
def test_a_link_that_is_refused_says_why(lab: Lab, side: str, fault: str, told: str) -> None:
    sites = Sites(lab)
    names = {"cloud": ("other.example" if fault == "name" else CLOUD,), "robot": ()}[side]
    bad = sites.files("bad", *names, ends=PAST if fault == "expired" else 90 * DAY)
    if fault in ("foreign", "same name"):
        other = Authority("another CA") if fault == "foreign" else Authority()
        other.write(bad, *names)
        (bad / certificates.CA).write_bytes(sites.authority.pem)
    sites.start_cloud(bad if side == "cloud" else None)
    sites.start_robot(bad if side == "robot" else None)
    subscriber = sites.in_cloud("sub")
    sites.at_robot("pub")

    def problems() -> dict[str, str]:
        return {problem.subject: problem.text for problem in lab.status().problems}

    subject = f"zenoh link tls/{CLOUD}:{ROUTER_PORT}"
    wait_until("the cause is told", lambda: told in problems().get(subject, ""), 30)
    if fault == "expired":
        role = "out" if side == "cloud" else "px"
        told_of_file = {problem.subject for problem in lab.status(role).problems}
        assert f"zenoh file {bad / certificates.CERTIFICATE}" in told_of_file
    assert "got" not in subscriber.output()
    # A good certificate in the same place is enough.
    sites.authority.write(bad, *((CLOUD,) if side == "cloud" else ()))
    flows(subscriber)
    wait_until("nothing is wrong", lambda: not problems(), 30)


def test_certificates_are_renewed_while_messages_flow(lab: Lab) -> None:
    sites = Sites(lab)
    certificates.mount(sites.volume, sites.files("first"))
    cloud_files = sites.files("cloud", CLOUD)
    cloud = sites.start_cloud(cloud_files)
    sites.start_robot(sites.volume)
    sites.wait_for_link()
    graph = sites.at_robot("graph")
    in_cloud = sites.in_cloud("sub")
    local = lab.node(VERSION, "c2", "sub")
    publisher = sites.at_robot("pub")
    flows(in_cloud)
    flows(local)
    assert lab.proxy is not None
    for number, (proxy, renew) in enumerate(
        [
            (lab.proxy, lambda: certificates.mount(sites.volume, sites.files("second"))),
            (cloud, lambda: sites.files("cloud", CLOUD)),
        ]
    ):
        mark = in_cloud.mark()
        renew()
        proxy.wait_for("were read again")
        began = time.monotonic()
        late = sites.in_cloud("pub", f"late{number}")
        graph.wait_for(f"^listed {late.title} MP ", timeout=30)
        flows(in_cloud)
        got = messages(in_cloud, mark)
        gap = max(after - before for before, after in pairwise(got))
        print(f"gap: {gap} messages at 10 Hz; graph after {time.monotonic() - began:.1f} s")
    told = messages(local)
    assert told == [*range(told[0], told[-1] + 1)], "a neighbour has lost messages"
    assert lab.zenoh().restarts == lab.zenoh("out").restarts == 0
    assert publisher.returncode is None


def test_the_files_may_come_after_the_start(lab: Lab) -> None:
    sites = Sites(lab)
    sites.start_cloud()
    sites.volume.mkdir()
    sites.start_robot(sites.volume, "--zenoh-await-files")
    in_cloud = sites.in_cloud("sub")
    local = lab.node(VERSION, "c2", "sub")
    sites.at_robot("pub")
    flows(local)
    wait_until("the missing file is told", lambda: lab.status().problems, 30)
    (problem,) = lab.status().problems
    assert problem.subject == f"zenoh file {sites.volume / certificates.CERTIFICATE}"
    assert "got" not in in_cloud.output()
    certificates.mount(sites.volume, sites.files("late"))
    flows(in_cloud)
    sites.wait_for_link()
    wait_until("nothing is wrong", lambda: not lab.status().problems, 30)
    told = messages(local)
    assert told == [*range(told[0], told[-1] + 1)], "a neighbour has lost messages"


@pytest.mark.parametrize("protocol", ["tls", "quic"])
def test_a_certificate_may_have_an_address_in_place_of_a_name(lab: Lab, protocol: str) -> None:
    sites = Sites(lab, protocol)
    address = lab.topology.places["out"].address
    sites.start_cloud(sites.files("cloud", address))
    link = ("--zenoh-link", f"{protocol}/{address}", *written(sites.files("client")))
    lab.start_proxy(*link, with_robot=False)
    sites.wait_for_link()
    assert not lab.status().problems


def test_two_hubs_with_a_link_each_pass_each_message_once(lab: Lab) -> None:
    """As on two nodes of a cluster: the hubs on px and c2 are linked, and each with the cloud."""
    sites = Sites(lab)
    sites.start_cloud()
    second = lab.topology.places["c2"].address
    hub = ("--zenoh-hub-listen", str(ROUTER_PORT))
    sites.start_robot(None, *hub, "--zenoh-hub", second)
    link = ("--zenoh-link", f"tls/{CLOUD}", *written(sites.files("second")))
    lab.start_proxy_on("c2", "--bind", second, *hub, *link)
    for role, count in (("px", 2), ("c2", 1)):
        linked = partial(all_up, lab, role, count)
        wait_until(f"the links of {role} are up", linked, 30)
    override = f'mode="client";connect/endpoints=["tcp/{second}:{PORTS["c1"]}"]'
    behind_second = lab.node(VERSION, "c2", "sub", ZENOH_CONFIG_OVERRIDE=override)
    in_cloud = sites.in_cloud("sub")
    back = sites.at_robot("sub", "map")
    sites.at_robot("pub")
    sites.in_cloud("pub", "map")
    for receiver in (behind_second, in_cloud, back):
        flows(receiver)
    for receiver in (behind_second, in_cloud, back):
        receiver.wait_for_count("^got hello ", 50, 30, since=receiver.mark())
        got = messages(receiver)
        assert got == [*range(got[0], got[-1] + 1)], "a message was lost or came twice"
    at_link = [s for s in lab.zenoh().sessions if s.mode == "router"]
    assert sorted(session.link for session in at_link) == [False, True]
    assert not lab.status().problems


def all_up(lab: Lab, role: str, count: int) -> bool:
    """Whether a proxy has so many links, and all of them are up."""
    links = lab.zenoh(role).links
    return len(links) == count and all(link.up for link in links)


@pytest.mark.parametrize("side", ["robot", "cloud"])
def test_a_link_comes_back_after_a_crash_of_routers(lab: Lab, side: str) -> None:
    sites = Sites(lab)
    cloud = sites.start_cloud()
    sites.start_robot()
    graph = sites.at_robot("graph")
    in_cloud = sites.in_cloud("sub")
    sites.at_robot("pub")
    flows(in_cloud)
    os.kill(lab.router_process() if side == "robot" else lab.router_process(cloud), 9)
    late = sites.in_cloud("pub", "late")
    graph.wait_for(f"^listed {late.title} MP ", timeout=30)
    flows(in_cloud)


@pytest.mark.parametrize("protocol", ["tls", "quic"])
def test_a_site_without_its_ca_is_excluded(lab: Lab, protocol: str) -> None:
    sites = Sites(lab, protocol)
    of_robot = Authority("CA of the robot")
    cloud_files = sites.files("cloud", CLOUD)
    own = (cloud_files / certificates.CA).read_bytes()
    (cloud_files / certificates.CA).write_bytes(own + of_robot.pem)
    robot_files = of_robot.write(lab.folder / "client")
    (robot_files / certificates.CA).write_bytes(own)
    sites.start_cloud(cloud_files)
    sites.start_robot(robot_files)
    subscriber = sites.in_cloud("sub")
    sites.at_robot("pub")
    flows(subscriber)
    (cloud_files / certificates.CA).write_bytes(own)

    def told(role: str) -> str:
        return "; ".join(f"{p.subject}: {p.text}" for p in lab.status(role).problems)

    refused = f"from a connection to {protocol}/{ROUTER_PORT}: the certificate is of a CA that"
    wait_until("the cloud tells the refusal", lambda: refused in told("out"), 30)
    expected = "a CA that the other proxy does not trust" if protocol == "tls" else "over UDP"
    wait_until("the robot tells the refusal", lambda: expected in told("px"), 30)
    mark = subscriber.mark()
    sites.in_cloud("pub", "other")
    flows(sites.in_cloud("sub", "other"))
    assert "got" not in subscriber.output(since=mark)


def test_a_key_that_zenoh_can_not_use_leaves_the_site_alone(lab: Lab) -> None:
    sites = Sites(lab)
    folder = sites.authority.write(lab.folder / "curve", CLOUD, curve=ec.SECP521R1())
    lab.start_proxy("--zenoh-link-listen", "tls/7447", *written(folder), with_robot=False)
    subscriber = lab.node(VERSION, "c2", "sub")
    sites.at_robot("pub")
    flows(subscriber)
    wait_until("the port is told", lambda: lab.status().problems, 30)
    (problem,) = lab.status().problems
    assert problem.subject == "zenoh port tls/7447"
    assert "ECDSA with P-256 and P-384" in problem.text
    assert lab.zenoh().restarts == 0


def test_a_limit_holds_for_the_link_alone(lab: Lab) -> None:
    sites = Sites(lab)
    sites.start_cloud()
    sites.start_robot(None, "--zenoh-limit", "/camera/**=2Hz")
    sites.wait_for_link()
    topics = ("camera/image", "chatter")
    far = {topic: sites.in_cloud("sub", topic) for topic in topics}
    near = {topic: lab.node(VERSION, "c2", "sub", topic) for topic in topics}
    for topic in topics:
        lab.node(VERSION, "c1", "pub", topic, NODE_PERIOD_S="0.02", **lab.as_client())
    flows(far["camera/image"])
    flows(far["chatter"])
    marks = {node.title: node.mark() for node in (*far.values(), *near.values())}
    near["camera/image"].wait_for_count("^got hello ", 300, 60, marks[near["camera/image"].title])
    counts = {
        (where, topic): len(messages(node, marks[node.title]))
        for where, nodes in (("far", far), ("near", near))
        for topic, node in nodes.items()
    }
    print(counts)
    assert counts["near", "camera/image"] > 5 * counts["far", "camera/image"] > 0
    assert counts["far", "chatter"] > 5 * counts["far", "camera/image"]


def test_rules_for_links_leave_the_site_alone(lab: Lab) -> None:
    sites = Sites(lab)
    sites.start_cloud()
    rules = "allow publish /status; deny publish *; deny serve *"
    sites.start_robot(None, "--zenoh-link-policy", rules)
    sites.wait_for_link()
    graph = sites.in_cloud("graph")
    topics = ("status", "private")
    far = {topic: sites.in_cloud("sub", topic) for topic in topics}
    near = {topic: lab.node(VERSION, "c2", "sub", topic) for topic in topics}
    publishers = {topic: sites.at_robot("pub", topic) for topic in topics}
    back = sites.at_robot("sub", "map")
    sites.in_cloud("pub", "map")
    sites.at_robot("serve", "reset")
    flows(sites.at_robot("call", "reset"), "^answer of ")
    probe = sites.in_cloud("probe", "**")
    for node in (far["status"], *near.values(), back):
        flows(node)
    assert "got" not in far["private"].output()
    probe.wait_for_count("^asked$", 2, timeout=30)
    assert "answer" not in probe.output()
    graph.wait_for(f"^listed {publishers['status'].title} MP ", timeout=30)
    assert f"listed {publishers['private'].title} " not in graph.output()


def test_a_link_to_the_proxy_itself_opens_no_way_past_the_rules(lab: Lab) -> None:
    """Only the hub and the router of the links speak TLS."""
    sites = Sites(lab)
    host = lab.topology.places["px"].address
    own = sites.files("own", host)
    hub_port = ROUTER_PORT + 10
    site_port = ROUTER_PORT + 11
    parts = (certificates.KEY, certificates.CERTIFICATE, certificates.CA)
    pem = "".join((own / part).read_text() for part in parts)
    ports = [*PORTS.values(), hub_port, site_port]
    lab.start_proxy(
        *("--zenoh-hub-listen", str(hub_port), "--zenoh-hub-certificate", pem),
        *("--zenoh-link-listen", f"tls/{site_port}", *written(own)),
        *(word for port in ports for word in ("--zenoh-link", f"tls/{host}:{port}")),
        *("--policy", "deny publish /denied"),
        with_robot=False,
    )
    for role in PORTS:
        lab.redirect(role)
    received = {name: lab.node(VERSION, "c2", "sub", name) for name in ("allowed", "denied")}
    sent = {name: sites.at_robot("pub", name) for name in received}
    flows(received["allowed"])
    faults = ["no TLS"] * len(PORTS) + ["no session"] * 2
    wait_until("the faults are told", lambda: [k.error for k in lab.zenoh().links] == faults, 30)
    sent["denied"].wait_for("^said")
    flows(received["allowed"])
    told = messages(received["allowed"])
    assert told == [*range(told[0], told[-1] + 1)], "messages came twice"
    assert "got" not in received["denied"].output()
