"""Updates of a controller about containers (gone, moved, arrived), and the end of a controller.

Machines replace containers. Inside, the master's host name leads to the proxy. A node that starts
while this name still leads to the real master registers directly, like a node in a container that
starts before the proxy has joined the network.
"""

from __future__ import annotations

import contextlib
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.ros.combinations import LIBRARIES, each_library
from tests.ros.lab import Lab
from tests.ros.processes import Process, wait_until
from tests.ros.topology import ALIAS, OUT_NODE, Place, run_command

pytestmark = pytest.mark.boundary

PLAN = replace(ALIAS, name="k", networks=(("c1", "c2", "c3"),))
PROXY_OPTIONS = ("--master-address", OUT_NODE)

Measure = Callable[[str, float], None]
ROLES = {"publisher": "pub", "subscriber": "sub", "server": "serve"}


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)


def names_file(place: Place) -> Path:
    return Path("/etc/netns") / place.namespace / "hosts"


@contextlib.contextmanager
def before_the_proxy(lab: Lab, role: str) -> Iterator[None]:
    """The time in which the master's name leads to the real master on a machine."""
    names = names_file(lab.place(role))
    before = names.read_text()
    proxy = lab.place("px").address
    names.write_text(before.replace(f"{proxy} robot\n", f"{OUT_NODE} robot\n"))
    assert names.read_text() != before
    try:
        yield
    finally:
        names.write_text(before)


@contextlib.contextmanager
def off_the_network(place: Place) -> Iterator[None]:
    """The machine's address answers nothing, as that of a container that has been removed."""
    routes = run_command("ip", "-n", place.namespace, "route", "show", "default").split()
    ip("-n", place.namespace, "link", "set", "eth0", "down")
    try:
        yield
    finally:
        ip("-n", place.namespace, "link", "set", "eth0", "up")
        if routes:
            ip("-n", place.namespace, "route", "replace", *routes)


@contextlib.contextmanager
def reached_by_the_master(lab: Lab, role: str) -> Iterator[None]:
    """Let the master reach this machine's address, as on the containers' host."""
    host = lab.place("host").namespace
    rule = ["ip", "netns", "exec", host, "nft", "-e", "-a"]
    words = f"insert rule ip boundary forward ip daddr {lab.place(role).address} accept"
    done = subprocess.run([*rule, *words.split()], check=True, capture_output=True, text=True)
    handle = done.stdout.rpartition("handle ")[2].split()[0]
    try:
        yield
    finally:
        words = f"delete rule ip boundary forward handle {handle}"
        subprocess.run([*rule, *words.split()], check=True, capture_output=True)


def stray(lab: Lab, library: str, kind: str, role: str = "c1", **options: Any) -> Process:
    """A node that registers directly, with the machine's address as its host."""
    env = options.pop("env", {"ROS_IP": lab.place(role).address})
    with before_the_proxy(lab, role):
        node = lab.node(library, role, kind, env=env, **options)
        node.wait_for("^ready")
        lab.wait_registered(options["name"])
        time.sleep(0.3)  # time for the logger's registrations
    return node


def arrived(lab: Lab, role: str = "c1", names: Sequence[str] = ()) -> dict[str, int]:
    container = {"address": lab.place(role).address, "names": [*names, lab.place(role).hostname]}
    return lab.tell("/containers", arrived=[container])


def is_leased(lab: Lab, name: str) -> bool:
    uri = lab.node_uri(name)
    return uri is not None and uri.startswith(f"http://{lab.advertise_host}:115")


@each_library
def test_nodes_of_a_container_that_is_gone(lab: Lab, library: str, measure: Measure) -> None:
    """After a kill of the container, the master knows none of the nodes within a second."""
    names = {role: lab.unique("gone") for role in ROLES.values()}
    nodes = [
        lab.node(library, "c3", role, name=name, topic=f"/{name}/t", service=f"/{name}/s")
        for role, name in names.items()
    ]
    for node, name in zip(nodes, names.values(), strict=True):
        node.wait_for("^ready")
        lab.wait_registered(name)
    listener = lab.node("roscpp", "out", "sub", topic=f"/{names['pub']}/t")
    # A silent node that has registered in the last 3 s gets a second chance: 20 messages a second.
    listener.wait_for_count("^got ", 75)
    for node in nodes:
        node.kill()
    with off_the_network(lab.place("c3")):
        started = time.time()
        assert lab.tell("/containers", gone=[lab.place("c3").address])["unregistered"] == 3
        assert not any(lab.registered(name) for name in names.values())
        assert not any(lab.node_uri(name) for name in names.values())
        took = time.time() - started
        measure("gone: 3 nodes unregistered", took)
        assert took < 15  # each node's own time-out: 15 s
        assert lab.tell("/containers", gone=[lab.place("c3").address])["unregistered"] == 0


@each_library
def test_a_node_that_answers_survives_the_update_that_it_is_gone(lab: Lab, library: str) -> None:
    name = lab.unique("alive")
    node = lab.node(library, "c3", "pub", name=name, topic=f"/{name}/t")
    node.wait_for("^ready")
    uri = lab.node_uri(name)
    assert lab.tell("/containers", gone=[lab.place("c3").address])["unregistered"] == 0
    lab.node(library, "out", "sub", topic=f"/{name}/t").wait_for_count("^got ", 3)
    assert lab.node_uri(name) == uri


@pytest.mark.direct
@each_library
def test_a_stray_publisher_is_adopted(lab: Lab, library: str, measure: Measure) -> None:
    """Subscribers from before and after, outside and inside, receive. The publisher lives on."""
    name = lab.unique("stray")
    topic = f"/{lab.unique('t')}"
    before = {
        (role, peer): lab.node(peer, role, "sub", topic=topic)
        for role in ("out", "c2")
        for peer in LIBRARIES
    }
    node = stray(lab, library, "pub", name=name, topic=topic)
    for peer in LIBRARIES:
        before["c2", peer].wait_for_count("^got ", 3)
    assert not is_leased(lab, name)
    started = time.time()
    assert arrived(lab)["adopted"] == 1
    assert is_leased(lab, name)
    for peer in LIBRARIES:
        before["out", peer].wait_for_count("^got ", 3)
    measure("adopted: heard outside", time.time() - started)
    for role in ("out", "c2", "c1"):
        for peer in LIBRARIES:
            lab.node(peer, role, "sub", topic=topic).wait_for_count("^got ", 3)
    assert node.returncode is None
    assert_no_gap(before["c2", "roscpp"])
    assert_no_gap(before["c2", "rospy"])
    assert arrived(lab)["adopted"] == 0


def assert_no_gap(receiver: Process) -> None:
    """Checks that each message has come once, so that the connection was never dropped."""
    numbers = [int(m[1]) for m in receiver.wait_for_count(r"^got hello (\d+) ", 3)]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers))), numbers


@pytest.mark.direct
@each_library
def test_a_stray_subscriber_is_adopted(lab: Lab, library: str) -> None:
    """The subscriber receives from known publishers without a gap, and from later publishers."""
    name = lab.unique("stray")
    topic = f"/{lab.unique('t')}"
    outside = lab.node("roscpp", "out", "pub", topic=topic)
    outside.wait_for("^sent ")
    node = stray(lab, library, "sub", name=name, topic=topic)
    node.wait_for_count("^got hello ", 3)
    assert arrived(lab)["adopted"] == 1
    assert_no_gap(node)
    for role in ("out", "c2", "c1"):
        for peer in LIBRARIES:
            text = lab.unique("word")
            lab.node(peer, role, "pub", topic=topic, word=text)
            node.wait_for_count(f"^got {text} ", 3)


@pytest.mark.direct
@each_library
def test_a_stray_server_is_adopted(lab: Lab, library: str) -> None:
    name = lab.unique("stray")
    node = stray(lab, library, "serve", name=name, service=f"/{name}/s")
    assert arrived(lab)["adopted"] == 1
    for role in ("out", "c2", "c1"):
        for peer in LIBRARIES:
            client = lab.node(peer, role, "call", service=f"/{name}/s")
            client.wait_for("^reply ask 0 ")
    assert node.returncode is None


@pytest.mark.direct
@each_library
def test_a_stray_under_a_name_that_only_its_container_knows(lab: Lab, library: str) -> None:
    name = lab.unique("stray")
    topic = f"/{lab.unique('t')}"
    stray(lab, library, "pub", name=name, topic=topic, env={})
    assert "c1box" in (lab.node_uri(name) or "")
    assert arrived(lab)["adopted"] == 1
    for role in ("out", "c2"):
        lab.node(library, role, "sub", topic=topic).wait_for_count("^got ", 3)


@pytest.mark.direct
@each_library
def test_rosnode_kill_ends_an_adopted_node(lab: Lab, library: str) -> None:
    name = lab.unique("stray")
    node = stray(lab, library, "pub", name=name, topic=f"/{name}/t")
    assert arrived(lab)["adopted"] == 1
    assert f"Pid: {node.pid}" in lab.run("out", "rosnode", "info", name).output
    lab.run("out", "rosnode", "kill", name)
    node.wait(timeout=60)
    lab.wait_unregistered(name)


@pytest.mark.direct
@pytest.mark.parametrize("way", [signal.SIGINT, signal.SIGKILL], ids=["sigint", "sigkill"])
@each_library
def test_an_adopted_node_that_ends_leaves_nothing(
    lab: Lab, library: str, way: signal.Signals, measure: Measure
) -> None:
    """The node unregisters directly, without effect: its connection to the master is still open."""
    started = {role: lab.unique("stray") for role in ROLES.values()}
    nodes = [
        stray(lab, library, role, name=name, topic=f"/{name}/t", service=f"/{name}/s")
        for role, name in started.items()
    ]
    assert arrived(lab)["adopted"] == 3
    for node in nodes:
        node.send(way)
    ended = time.time()
    for name in started.values():
        lab.wait_unregistered(name)
    measure("adopted, then ended: unregistered", time.time() - ended)


@pytest.mark.direct
@each_library
def test_strays_that_the_master_reaches_are_not_shut_down(
    lab: Lab, library: str, tmp_path: Path
) -> None:
    """Adopted although the master reaches the node, and again after a further direct
    registration.
    """
    name = lab.unique("stray")
    more = tmp_path / "more"
    with reached_by_the_master(lab, "c1"):
        node = stray(
            lab, library, "more", name=name, topic=f"/{name}/a", then=f"/{name}/b", when=more
        )
        assert arrived(lab)["adopted"] == 1
        lab.node(library, "out", "sub", topic=f"/{name}/a").wait_for_count("^got ", 3)
        more.touch()
        node.wait_for("^more")
        for topic in ("a", "b"):
            lab.node(library, "out", "sub", topic=f"/{name}/{topic}").wait_for_count("^got ", 3)
        wait_until("the node is behind the proxy again", lambda: is_leased(lab, name))
        assert node.returncode is None


def provider(lab: Lab, service: str) -> str:
    """The URI of a service at the master; empty without a provider, or during a change."""
    try:
        return str(lab.ask_master("lookupService", service))
    except LookupError:
        return ""


@pytest.mark.direct
@each_library
def test_a_stray_that_is_adopted_while_it_registers(lab: Lab, library: str) -> None:
    """Some registrations go to the master directly after the adoption."""
    nodes = []
    names = [lab.unique("stray") for _ in range(4)]
    with reached_by_the_master(lab, "c1"), before_the_proxy(lab, "c1"):
        for name in names:
            options = {"env": {"ROS_IP": lab.place("c1").address}, "topic": f"/{name}/t"}
            nodes.append(lab.node(library, "c1", "pub", name=name, **options))
        end = time.time() + 60
        while not all(is_leased(lab, name) for name in names):
            arrived(lab)
            assert time.time() < end
        for name in names:
            lab.node(library, "out", "sub", topic=f"/{name}/t").wait_for_count("^got ", 3)
        for service in (f"/{name}/get_loggers" for name in names):
            expectation = f"the service {service} is behind the proxy"
            wait_until(expectation, lambda s=service: ":115" in provider(lab, s))
        assert [node.returncode for node in nodes] == [None] * 4
        assert all(is_leased(lab, name) for name in names)


@pytest.mark.direct
@each_library
def test_an_adopted_node_that_drops_a_topic_around_the_proxy(
    lab: Lab, library: str, tmp_path: Path
) -> None:
    name = lab.unique("stray")
    more = tmp_path / "more"
    node = stray(
        lab, library, "more", name=name, topic=f"/{name}/a", then=f"/{name}/b", when=more, last=1
    )
    assert arrived(lab)["adopted"] == 1
    more.touch()
    node.wait_for("^more")
    lab.node(library, "out", "sub", topic=f"/{name}/b").wait_for_count("^got ", 3)
    wait_until("the topic is gone", lambda: not lab.users(f"/{name}/a")[0])


@pytest.mark.direct
@each_library
def test_a_stray_that_registers_through_the_proxy_before_the_update(
    lab: Lab, library: str, tmp_path: Path
) -> None:
    """The node has lost its connection to the master. The next registration brings the others
    along.
    """
    name = lab.unique("stray")
    more = tmp_path / "more"
    with reached_by_the_master(lab, "c1"):
        node = stray(
            lab, library, "more", name=name, topic=f"/{name}/a", then=f"/{name}/b", when=more
        )
        end_connections(lab.place("c1"), OUT_NODE)
        more.touch()
        node.wait_for("^more")
        for topic in ("a", "b"):
            lab.node(library, "out", "sub", topic=f"/{name}/{topic}").wait_for_count("^got ", 3)
        assert is_leased(lab, name)
        assert arrived(lab)["adopted"] == 0
        assert node.returncode is None


def end_connections(place: Place, master: str) -> None:
    """Ends the idle connections from a machine's nodes to the master."""
    ip("netns", "exec", place.namespace, "ss", "-K", "dst", master, "dport", "=", ":11311")


@contextlib.contextmanager
def address_changed(place: Place, after: str) -> Iterator[None]:
    """Gives the machine another address, like a container that left and rejoined its network."""
    before = place.address
    gateway = place.address.rpartition(".")[0] + ".1"

    def change(old: str, new: str) -> None:
        ip("-n", place.namespace, "addr", "del", f"{old}/24", "dev", "eth0")
        ip("-n", place.namespace, "addr", "add", f"{new}/24", "dev", "eth0")
        ip("-n", place.namespace, "route", "replace", "default", "via", gateway)
        place.addresses[0] = new

    change(before, after)
    try:
        yield
    finally:
        change(after, before)


@each_library
def test_a_container_that_has_moved(
    lab: Lab, library: str, measure: Measure, tmp_path: Path
) -> None:
    """The node is reached again on the same port, outside and inside, and may register more."""
    name = lab.unique("moved")
    more = tmp_path / "more"
    place = lab.place("c3")
    options = {"topic": f"/{name}/a", "then": f"/{name}/b", "when": more}
    env = {"ROS_IP": place.address}
    node = lab.node(library, "c3", "more", name=name, env=env, **options)
    server = lab.node(library, "c3", "serve", name=f"{name}_s", service=f"/{name}/s", env=env)
    receiver = lab.node(library, "c3", "sub", name=f"{name}_r", topic=f"/{name}/c", env=env)
    for process in (node, server, receiver):
        process.wait_for("^ready")
    peers = [lab.node(p, r, "sub", topic=f"/{name}/a") for r in ("out", "c2") for p in LIBRARIES]
    for peer in peers:
        peer.wait_for_count("^got ", 3)
    # The proxy ends connections after 75 idle seconds. A kept connection hangs with the old
    # address.
    end_connections(place, lab.place("px").address)
    before = lab.node_uri(name)
    old = place.address
    with address_changed(place, old.rpartition(".")[0] + ".99"):
        marks = [peer.mark() for peer in peers]
        moved = time.time()
        assert lab.tell("/containers", moved={old: place.address})["moved"] == 3
        for peer, mark in zip(peers, marks, strict=True):
            peer.wait_for_count("^got ", 3, since=mark)
        measure("moved: heard again", time.time() - moved)
        assert before is not None
        assert lab.node_uri(name) == before
        more.touch()
        for role in ("out", "c2"):
            lab.node(library, role, "sub", topic=f"/{name}/b").wait_for_count("^got ", 3)
            lab.node(library, role, "call", service=f"/{name}/s").wait_for("^reply ask 0 ")
            text = lab.unique("word")
            lab.node(library, role, "pub", topic=f"/{name}/c", word=text)
            receiver.wait_for_count(f"^got {text} ", 3)
        assert lab.node_uri(name) == before
        assert lab.tell("/containers", moved={old: place.address})["moved"] == 0
        assert node.stop() == 0
        lab.wait_unregistered(name, timeout=2)  # by itself, before --cleanup-after 3


def test_a_retired_proxy_leaves_nothing_at_the_master(lab: Lab) -> None:
    names = [lab.unique("last") for _ in LIBRARIES]
    for library, name in zip(LIBRARIES, names, strict=True):
        lab.node(library, "c1", "pub", name=name, topic=f"/{name}/t").wait_for("^ready")
    assert lab.tell("/retire")["unregistered"] >= 2
    assert not any(lab.registered(name) for name in names)
    late = ("registerPublisher", "/late", "std_msgs/String", "http://c1box:1/")
    with pytest.raises(ConnectionResetError):  # so a node tries again, at the next proxy
        lab.ask_master(*late, role="c1")
    assert not lab.users("/late")[0]
    assert lab.proxy is not None
    lab.proxy.stop()
    lab.start_proxy()
