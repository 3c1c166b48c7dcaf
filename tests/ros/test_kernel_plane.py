"""Topics on the kernel plane: real nodes behind a proxy with the rights for nftables."""

from __future__ import annotations

import shutil
import signal
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from tests.ros import kernel
from tests.ros.combinations import LIBRARIES, each_library, each_pair
from tests.ros.kernel import LIMIT, talk
from tests.ros.lab import SYSTEM_PATH, Lab
from tests.ros.processes import wait_until
from tests.ros.topology import SHARED

pytestmark = pytest.mark.boundary

PLAN = replace(SHARED, name="w", forwarding=True)
PROXY_OPTIONS = ("--probe-interval", "0.5", "--linger", "1")
PRIVILEGE = "net_admin"


@each_pair("publisher", "subscriber")
def test_the_kernel_forwards_a_topic(lab: Lab, publisher: str, subscriber: str) -> None:
    name, _, receiver = talk(lab, publisher, subscriber)
    plane = kernel.wait_forwarded(lab, name)
    topic = next(
        published
        for published in kernel.node_status(lab, name)["publishes"]
        if published != "/rosout"
    )
    lab.wait_shown(topic, carried="kernel", port=plane["port"], state="ok", flows=True)
    assert plane["reason"] == ""
    assert plane["received"] > 0
    assert kernel.node_status(lab, name)["connections"] == []
    listed = [line for line in kernel.flows(lab).splitlines() if f"dport={plane['port']}" in line]
    assert any("ESTABLISHED" in line and lab.place("c1").address in line for line in listed)
    # A connection for /rosout comes later. Then the table has as many as the JSON.
    wait_until("the table has the connections", lambda: kernel.in_table(lab, name))
    kernel.wait_more(receiver)
    wait_until("more is counted", lambda: kernel.plane_of(lab, name)["sent"] > plane["sent"])


def test_an_inside_node_in_no_common_network_is_forwarded_too(lab: Lab) -> None:
    topic = f"/{lab.unique('topic')}"
    name = lab.unique("talker")
    lab.node("roscpp", "c1", "pub", name=name, topic=topic, rate=50)
    lab.wait_registered(name)
    receiver = lab.node("roscpp", "c2", "sub", topic=topic)
    receiver.wait_for_count("^got ", 5, LIMIT)
    kernel.wait_forwarded(lab, name)


@each_library
def test_messages_go_on_while_the_proxy_is_dead_and_after(lab: Lab, library: str) -> None:
    name = kernel.outlive_a_kill(lab, library)
    late = lab.node(library, "out", "sub", topic=kernel.node_status(lab, name)["publishes"][1])
    late.wait_for_count("^got ", 5, LIMIT)
    assert kernel.node_status(lab, name)["connections"] == []


def test_a_graceful_stop_leaves_nothing_in_the_kernel(lab: Lab) -> None:
    kernel.end_without_a_trace(lab)


@each_library
def test_the_port_of_a_killed_node_refuses(lab: Lab, library: str) -> None:
    name, sender, _ = talk(lab, library)
    port = kernel.wait_forwarded(lab, name)["port"]
    assert not kernel.refuses(lab, port)
    sender.kill()
    wait_until("the port refuses", lambda: kernel.refuses(lab, port), LIMIT)
    wait_until("nothing is forwarded", lambda: port not in kernel.forwarded_ports(lab), LIMIT)


@each_library
def test_a_restarted_node_is_forwarded_again(lab: Lab, library: str) -> None:
    name, sender, receiver = talk(lab, library, library)
    topic = kernel.node_status(lab, name)["publishes"][1]
    kernel.wait_forwarded(lab, name)
    sender.kill()
    lab.node(library, "c1", "pub", name=name, topic=topic, rate=50, word="again")
    receiver.wait_for_count("^got again ", 10, LIMIT)
    kernel.wait_forwarded(lab, name)


def test_a_removed_table_is_made_again(lab: Lab) -> None:
    name, _, _ = talk(lab)
    port = kernel.wait_forwarded(lab, name)["port"]
    kernel.in_proxy(lab, "nft", "delete", "table", "inet", kernel.TABLE)
    wait_until("the table is there", lambda: kernel.TABLE in kernel.tables(lab), LIMIT)
    wait_until("the port is forwarded", lambda: port in kernel.forwarded_ports(lab), LIMIT)
    late = lab.node("rospy", "out", "sub", topic=kernel.node_status(lab, name)["publishes"][1])
    late.wait_for_count("^got ", 5, LIMIT)
    assert kernel.node_status(lab, name)["connections"] == []


def test_a_node_that_does_not_answer_the_kernel_is_served_by_the_proxy(lab: Lab) -> None:
    topic, seen = kernel.status_of_unanswered(lab)
    assert seen["data_plane"]["plane"] == "splice"
    assert "did not answer through the kernel" in seen["data_plane"]["reason"]
    assert topic in [connection["name"] for connection in seen["connections"]]


def test_without_the_capability_the_proxy_splices_and_says_why(lab: Lab) -> None:
    with kernel.other_proxy(lab, ("setpriv", f"--bounding-set=-{PRIVILEGE}")):
        name, _, receiver = talk(lab)
        seen = kernel.status(lab)["data_plane"]
        assert seen["mode"] == "auto"
        assert seen["plane"] == "splice"
        assert "NET_ADMIN" in seen["reason"]
        node = kernel.node_status(lab, name)
        assert node["data_plane"]["port"] is None
        assert len(node["connections"]) > 0
        kernel.wait_more(receiver)
        assert "NET_ADMIN" in lab.rosproxy("status").output


@pytest.fixture
def tools() -> Iterator[Path]:
    """A folder with copies of nft and conntrack that carry the capability, as in the image."""
    folder = Path(tempfile.mkdtemp(prefix="rosproxy-tools-"))
    folder.chmod(0o755)
    for name in ("nft", "conntrack"):
        program = shutil.which(name, path=SYSTEM_PATH)
        assert program is not None
        shutil.copy(program, folder / name)
        subprocess.run(["setcap", f"cap_{PRIVILEGE}=ep", str(folder / name)], check=True)
    yield folder
    shutil.rmtree(folder)


def test_an_unprivileged_user_uses_programs_with_the_capability(lab: Lab, tools: Path) -> None:
    user = ("setpriv", "--reuid=10001", "--regid=10001", "--clear-groups")
    with kernel.other_proxy(lab, user, f"{tools}:{SYSTEM_PATH}"):
        name, _, receiver = talk(lab, *LIBRARIES)
        assert kernel.wait_forwarded(lab, name)["port"] is not None
        kernel.wait_more(receiver)
        assert lab.proxy is not None
        lab.proxy.stop(signal.SIGTERM)
        assert "rosproxy" not in kernel.tables(lab)
        lab.start_proxy()


def test_no_new_privileges_defeats_the_capability(lab: Lab, tools: Path) -> None:
    user = ("setpriv", "--reuid=10001", "--regid=10001", "--clear-groups", "--no-new-privs")
    with kernel.other_proxy(lab, user, f"{tools}:{SYSTEM_PATH}"):
        talk(lab)
        seen = kernel.status(lab)["data_plane"]
        assert seen["plane"] == "splice"
        assert "no-new-privileges" in seen["reason"]
