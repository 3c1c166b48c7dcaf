"""Ports that are published while outside goes on sending: each node's messages soon arrive again.

An engine before 23.0, such as that of Debian 12, keeps conntrack entries without DNAT from the time
before the ports were published. The operator deletes these entries.
"""

import re
import time
from collections.abc import Callable, Iterator

import pytest

from tests.docker.controller import Controller, Proxy, proxies, the_proxy
from tests.docker.engine import docker, inspect, run, wait_until
from tests.docker.inside import ENABLE
from tests.docker.ros2 import HERE, THERE, Flow, Inside2, Outside, all_run, domain, ports_are_kept
from tests.docker.ros2 import OPTIONS as ROS2_OPTIONS
from tests.docker.test_uninstall import uninstall

OPTIONS = ROS2_OPTIONS
SOON_S = 10
"""Seconds after which messages flow again, once all parts run."""
DISPOSED_S = 5
"""Seconds in which outside forgets a node after a dispose message. Without, the time is 20 s."""
VENDORS = pytest.mark.parametrize("vendor", ["jazzy", "cyclone"])
Start = Callable[..., Controller]

pytestmark = pytest.mark.usefixtures("_nodes_end")


@pytest.fixture
def _nodes_end(lan: Outside) -> Iterator[None]:
    yield
    lan.end()


def make_flow(lan: Outside, inside2: Inside2, vendor: str) -> Flow:
    """Traffic whose participants inside keep their ports."""
    flow = Flow(lan, inside2, vendors=(vendor, vendor))
    flow.wait(0)
    proxy = the_proxy()
    wait_until(lambda: ports_are_kept(proxy), 30, lambda: str(domain(proxy).inside))
    return flow


def flush_of(proxy: Proxy) -> str:
    return f"{proxy.name}-flush"


@VENDORS
def test_nodes_that_run_through_uninstall_and_install(
    vendor: str,
    start_controller: Start,
    lan: Outside,
    inside2: Inside2,
    controller_image: str,
    proxy_image: str,
) -> None:
    controller = start_controller(*OPTIONS)
    flow = make_flow(lan, inside2, vendor)
    docker("rm", "--force", controller.container)
    began = time.time()

    uninstall(controller_image, proxy_image)
    start_controller(*OPTIONS)

    proxy = the_proxy(60)
    wait_until(lambda: all_run(proxy), 30, lambda: docker("ps", "--all"))
    again = time.time()
    flow.wait(since=again, seconds=SOON_S)
    print(f"{vendor}, since uninstall: {flow.gaps(began)}; since all ran again: {flow.gaps(again)}")


def test_uninstall_sends_dispose_messages_outside(
    start_controller: Start,
    lan: Outside,
    inside2: Inside2,
    controller_image: str,
    proxy_image: str,
) -> None:
    """Without dispose messages outside keeps nodes inside for 20 s."""
    controller = start_controller(*OPTIONS)
    flow = make_flow(lan, inside2, "jazzy")
    watcher = lan.node("jazzy", "names", "/any").log.read
    wait_for_names(watcher, flow.talker.node, there=True)
    docker("rm", "--force", controller.container)

    said = uninstall(controller_image, proxy_image)

    wait_for_names(watcher, flow.talker.node, there=False, seconds=DISPOSED_S)
    assert "outside was told that 2 nodes or participants have ended" in said


def wait_for_names(read: Callable[[], str], name: str, there: bool, seconds: float = 60) -> None:
    """Wait until a node outside knows another node, or no longer does."""

    def holds() -> bool:
        lines = re.findall("^nodes .* end$", read(), re.MULTILINE)
        return bool(lines) and (name in lines[-1].split()) == there

    wait_until(holds, seconds, read)


@VENDORS
@pytest.mark.parametrize("how", ["kill", "rm --force"])
def test_a_sandbox_that_is_lost(
    how: str, vendor: str, start_controller: Start, lan: Outside, inside2: Inside2
) -> None:
    start_controller(*OPTIONS)
    flow = make_flow(lan, inside2, vendor)
    proxy = the_proxy()
    former = inspect(proxy.sandbox)["State"]["StartedAt"]
    lost = time.time()

    docker(*how.split(), proxy.sandbox)

    wait_until(lambda: runs_anew(proxy, former), 60, lambda: docker("ps", "--all"))
    flow.wait(since=time.time(), seconds=SOON_S)
    print(f"docker {how} of the sandbox, {vendor}: {flow.gaps(lost)}")


@VENDORS
def test_a_range_that_grows(
    vendor: str, start_controller: Start, lan: Outside, inside2: Inside2
) -> None:
    """The advice where ports are short: the sandbox is made anew."""
    start_controller(*OPTIONS)
    flow = make_flow(lan, inside2, vendor)
    proxy = the_proxy()
    former = inspect(proxy.sandbox)["State"]["StartedAt"]
    grown = time.time()

    inside2.made.idle(
        inside2.made.networks[0], labels=(ENABLE, "rosproxy.ros=2", "rosproxy.ports=64")
    )

    wait_until(lambda: runs_anew(proxy, former), 60, lambda: docker("ps", "--all"))
    flow.wait(since=time.time(), seconds=SOON_S)
    print(f"the range grows, {vendor}: {flow.gaps(grown)}")
    assert len(proxy.ports) == 64
    lost = time.time()
    docker("kill", proxy.name)
    wait_until(lambda: all_run(proxy), 60, lambda: docker("ps", "--all"))
    flow.wait(since=time.time(), seconds=SOON_S)
    print(f"proxy killed after growth, {vendor}: {flow.gaps(lost)}")


def runs_anew(proxy: Proxy, former: str) -> bool:
    """Whether all parts run, and the sandbox in a later start than ``former``."""
    inspection = inspect(proxy.sandbox, check=False)
    is_anew = bool(inspection) and inspection["State"]["StartedAt"] != former
    return is_anew and all_run(proxy)


def test_the_flush_deletes_entries_for_its_udp_ports_alone(
    start_controller: Start, inside2: Inside2
) -> None:
    start_controller(*OPTIONS)
    inside2.node(inside2.made.network(), "jazzy", "pub", "/out")
    proxy = the_proxy()
    flush = flush_of(proxy)
    wait_until(lambda: has_ended(flush), 30, lambda: docker("ps", "--all"))
    first = proxy.ports[0]
    relay = proxy.ports[-1]
    deleted = [("udp", HERE, first), ("udp", HERE, relay - 1), ("udp", "2001:db8::1", first)]
    kept = [("udp", HERE, relay), ("udp", HERE, first - 1), ("tcp", HERE, first)]
    for entry in (*deleted, *kept):
        insert(*entry)
    before = inspect(flush)["State"]["StartedAt"]

    docker("start", flush)

    wait_until(
        lambda: inspect(flush)["State"]["StartedAt"] != before and has_ended(flush),
        30, lambda: docker("ps", "--all"),
    )  # fmt: skip
    assert not [entry for entry in deleted if listed(*entry)]
    assert [entry for entry in kept if listed(*entry)] == kept


SOURCE_PORT = 7777


def insert(protocol: str, address: str, port: int) -> None:
    """Make a conntrack entry of a datagram or connection from outside that ended at this host."""
    source = "2001:db8::2" if ":" in address else THERE
    words = ["-p", protocol, "-s", source, "-d", address, "--sport", str(SOURCE_PORT)]
    state = ["--state", "ESTABLISHED"] if protocol == "tcp" else []
    run("conntrack", "-I", *words, "--dport", str(port), "-t", "600", *state)


def listed(protocol: str, address: str, port: int) -> bool:
    words = ["-p", protocol, "-d", address, "--sport", str(SOURCE_PORT), "--dport", str(port)]
    return f"dport={port}" in run("conntrack", "-L", *words)


def has_ended(container: str) -> bool:
    """Whether a container is there and has ended well."""
    state = inspect(container, check=False).get("State", {})
    return (state.get("Status"), state.get("ExitCode")) == ("exited", 0)


def test_the_flush_has_one_right_in_the_hosts_network(
    start_controller: Start, inside2: Inside2
) -> None:
    controller = start_controller(*OPTIONS)
    inside2.node(inside2.made.network(), "jazzy", "pub", "/out")
    proxy = the_proxy()
    flush = flush_of(proxy)
    wait_until(lambda: has_ended(flush), 30, controller.logs)

    host = inspect(flush)["HostConfig"]

    assert (host["NetworkMode"], host["ReadonlyRootfs"], host["Privileged"]) == (
        "host",
        True,
        False,
    )
    assert (host["CapDrop"], host["CapAdd"]) == (["ALL"], ["NET_ADMIN"])
    assert not host["Binds"]
    assert controller.command("plan", "--wait", "30") == "Nothing to do."
    assert proxies() == [proxy]
