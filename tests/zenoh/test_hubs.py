"""Proxies on two hosts that name each other (`--zenoh-hub`), as on two nodes of a cluster."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from rosproxy.admin.status_document import ZenohSessionStatus
from tests.ros.processes import Process, wait_until
from tests.ros.topology import give, ip
from tests.zenoh.lab import ROUTER_PORT, Lab

VERSION = "1.6.2"
FIRST = "hub-a"
"""The name of the proxy on the machine px."""
SECOND = "hub-b"
"""The name of the proxy on the machine c2, which gets another address."""
OTHER_ADDRESS = "172.30.1.40"
HEALED_WITHIN_S = 10.0
CHURN_WATCH_S = 15.0


class Hubs:
    """The proxies on px and c2, and a node at each: c1 publishes, c2 subscribes."""

    def __init__(self, lab: Lab) -> None:
        self.lab = lab
        self.place = lab.topology.places["c2"]
        self.address = self.place.address
        self.name(FIRST, lab.topology.places["px"].address, "c2")
        self.name(SECOND, self.address, "px")

    def name(self, name: str, address: str, role: str) -> None:
        """Have a machine resolve a name to another address, also for programs that run."""
        hosts = Path("/etc/netns") / self.lab.topology.places[role].namespace / "hosts"
        lines = [line for line in hosts.read_text().splitlines() if not line.endswith(name)]
        hosts.write_text("\n".join([*lines, f"{address} {name}"]) + "\n")

    def start_first(self) -> None:
        options = ("--zenoh-listen", str(ROUTER_PORT), "--zenoh-hub", SECOND)
        self.lab.start_proxy(*options, with_robot=False)

    def start_second(self, *options: str) -> Process:
        listen = ("--bind", self.address, "--zenoh-listen", str(ROUTER_PORT))
        return self.lab.start_proxy_on("c2", *listen, *options)

    def start_nodes(self) -> Process:
        """The subscriber, of a publisher behind the other proxy."""
        override = f'mode="client";connect/endpoints=["tcp/{self.address}:7448"]'
        subscriber = self.lab.node(VERSION, "c2", "sub", ZENOH_CONFIG_OVERRIDE=override)
        self.lab.node(VERSION, "c1", "pub")
        return subscriber

    def sessions(self) -> tuple[ZenohSessionStatus, ...]:
        """The sessions of the first hub with routers."""
        return tuple(s for s in self.lab.zenoh().sessions if s.mode == "router")

    def wait_for_link(self, role: str = "px") -> None:
        wait_until("the link is up", lambda: self.lab.zenoh(role).links[0].up, 30)


@pytest.fixture
def hubs(lab: Lab) -> Iterator[Hubs]:
    yield Hubs(lab)
    give_back = ("addr", "del", f"{OTHER_ADDRESS}/24", "dev", "eth0")
    if OTHER_ADDRESS in lab.topology.places["c2"].addresses:
        ip("-n", lab.topology.places["c2"].namespace, *give_back)
        lab.topology.places["c2"].addresses.remove(OTHER_ADDRESS)


def moved(hubs: Hubs, second: Process) -> None:
    """Kill the second proxy, and give its machine and its name another address."""
    os.kill(second.pid, 9)
    second.wait()
    give(hubs.place, "eth0", f"{OTHER_ADDRESS}/24")
    hubs.address = OTHER_ADDRESS
    hubs.name(SECOND, OTHER_ADDRESS, "px")


def test_two_hubs_that_name_each_other_keep_one_session(hubs: Hubs) -> None:
    hubs.start_first()
    hubs.start_second("--zenoh-hub", FIRST)
    subscriber = hubs.start_nodes()
    subscriber.wait_for_count("^got hello ", 5, timeout=30)
    hubs.wait_for_link("px")
    hubs.wait_for_link("c2")
    (session,) = hubs.sessions()
    mark = subscriber.mark()
    until = time.monotonic() + CHURN_WATCH_S
    while time.monotonic() < until:
        assert hubs.sessions() == (session,)
        time.sleep(0.5)
    assert hubs.lab.zenoh().restarts == 0
    assert not hubs.lab.status().problems
    got = [line for line in subscriber.output(since=mark).splitlines() if line.startswith("got ")]
    assert len(got) == len(set(got)) > CHURN_WATCH_S * 5, "a message was lost or came twice"


def test_a_hub_that_is_away_is_no_fault(hubs: Hubs) -> None:
    hubs.start_first()
    wait_until("the link was tried", lambda: hubs.lab.zenoh().links[0].error == "refused", 30)
    assert not hubs.lab.status().problems


@pytest.mark.parametrize("dials", [True, False], ids=["both dial", "the other dials"])
def test_a_hub_comes_back_at_another_address(hubs: Hubs, dials: bool) -> None:
    hubs.start_first()
    options = ("--zenoh-hub", FIRST) if dials else ()
    second = hubs.start_second(*options)
    hubs.start_nodes().wait_for_count("^got hello ", 5, timeout=30)
    moved(hubs, second)
    wait_until("the session is gone", lambda: not hubs.sessions(), 30)
    hubs.start_second(*options)
    began = time.monotonic()
    override = f'mode="client";connect/endpoints=["tcp/{hubs.address}:7448"]'
    subscriber = hubs.lab.node(VERSION, "c2", "sub", ZENOH_CONFIG_OVERRIDE=override)
    subscriber.wait_for("^got hello ", timeout=HEALED_WITHIN_S)
    print(f"healed after {time.monotonic() - began:.1f} s")
    hubs.wait_for_link()
