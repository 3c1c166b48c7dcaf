"""Proxies on two hosts that name each other (`--zenoh-hub`), as on two nodes of a cluster."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from rosproxy.shared.documents.status_document import ZenohSessionStatus
from rosproxy_operator.kubernetes.proxies.hub_certificate import hub_certificate
from rosproxy_operator.kubernetes.resources.model import Name
from rosproxy_operator.kubernetes.resources.names import hub_address
from tests.ros.processes import Process, wait_until
from tests.ros.topology import give, ip
from tests.zenoh.lab import ROUTER_PORT, Lab

VERSION = "1.6.2"
KEY = bytes(32)
OF = Name("robots", "zenoh")
FIRST = hub_address(OF, "a").host
"""The name of the proxy on the machine px."""
SECOND = hub_address(OF, "b").host
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

    def start_first(self, *, key: bytes = KEY, with_robot: bool = False) -> None:
        options = (*listening(key), "--zenoh-hub", SECOND)
        self.lab.start_proxy(*options, with_robot=with_robot)

    def start_second(self, *options: str, key: bytes = KEY) -> Process:
        bind = ("--bind", self.address)
        return self.lab.start_proxy_on("c2", *bind, *listening(key), *options)

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


def listening(key: bytes) -> tuple[str, ...]:
    """The options of a hub for other hubs, which have the same certificate; b"": none has any."""
    port = ("--zenoh-hub-listen", str(ROUTER_PORT))
    return (*port, "--zenoh-hub-certificate", hub_certificate(key, OF)) if key else port


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


@pytest.mark.parametrize("key", [KEY, b""], ids=["certificate", "plain"])
def test_two_hubs_that_name_each_other_keep_one_session(hubs: Hubs, key: bytes) -> None:
    hubs.start_first(key=key)
    hubs.start_second("--zenoh-hub", FIRST, key=key)
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


def test_hubs_with_a_certificate_still_dial_a_router_without(hubs: Hubs) -> None:
    hubs.lab.start_router(VERSION)
    hubs.start_first(with_robot=True)
    hubs.start_second()
    subscriber = hubs.start_nodes()
    robot = hubs.lab.node(VERSION, "out", "sub")
    for node in (subscriber, robot):
        node.wait_for_count("^got hello ", 5, timeout=30)


def test_a_program_without_the_certificate_has_no_session_with_a_hub(hubs: Hubs) -> None:
    hubs.start_first()
    address = hubs.lab.topology.places["px"].address
    endpoints = f'connect/endpoints=["tcp/{address}:{ROUTER_PORT}"];connect/timeout_ms=-1'
    stranger = hubs.lab.node(
        VERSION, "c2", "sub", ZENOH_CONFIG_OVERRIDE=f'mode="client";{endpoints}'
    )
    accepted = hubs.lab.node(VERSION, "c1", "sub")
    hubs.lab.node(VERSION, "c1", "pub")
    accepted.wait_for_count("^got hello ", 20, timeout=30)
    assert "ready" not in stranger.output()
    assert len(hubs.lab.zenoh().sessions) == 2


def test_a_hub_with_another_certificate_is_told(hubs: Hubs) -> None:
    hubs.start_first()
    hubs.start_second(key=b"1" * 32)

    def told() -> list[str]:
        return [f"{p.subject}: {p.text}" for p in hubs.lab.status().problems]

    wait_until("the fault is told", lambda: bool(told()), 30)
    assert told()[0].startswith(f"zenoh hub {SECOND}:{ROUTER_PORT}: the certificate of the")
    assert not hubs.sessions()


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
