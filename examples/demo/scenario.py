"""The acts of the demonstration, and the checks of each act.

All of 127.0.0.0/8 is loopback on Linux, so each side gets a separate network without root: outside
is 127.0.1.0/24, inside is 127.0.2.0/24. As with NAT, inside nodes reject every connection from an
outside address, and announce host names that no resolver knows. The proxy is a plain process
without any restriction, and reaches both sides. A system that has only 127.0.0.1 (macOS) has both
sides at that address. There only the names separate the sides.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass, field
from ipaddress import ip_address, ip_network
from time import monotonic
from typing import Any

from examples.demo.fake_http import free_ports, host_and_port, is_free
from examples.demo.fake_master import CALL_ERRORS, FakeMaster
from examples.demo.players import Actor, Adder, Listener, Talker, in_words
from examples.demo.proxy_process import DemoError, ProxyProcess
from examples.demo.ros2_acts import Ros2Acts, Ros2Listener, Ros2Talker
from rosproxy.shared.addresses import HostPort

PATIENCE = 30.0
"""Seconds to wait for an event. Long, so that a slow machine does not fail the demonstration."""
LEASES = 8
"""Ports of the range. A ROS 1 node takes one; a ROS 2 node two of UDP, and the proxy one of UDP."""

AnyTalker = Talker | Ros2Talker
AnyListener = Listener | Ros2Listener


@dataclass(frozen=True)
class Layout:
    """Addresses of all parts. Inside rejects connections from `outside_network`, unless empty."""

    host: str = "127.0.1.1"
    robot: str = "127.0.1.10"
    proxy_inside: str = "127.0.2.1"
    inside: tuple[str, ...] = ("127.0.2.11", "127.0.2.12", "127.0.2.13")
    inside_network: str = "127.0.2.0/24"
    outside_network: str = "127.0.1.0/24"

    def admits(self, peer: str) -> bool:
        """Whether inside nodes take connections from `peer`."""
        return not self.outside_network or (
            ip_address(peer) not in ip_network(self.outside_network)
        )


LOOPBACK = "127.0.0.1"
NAMES_ONLY = Layout(LOOPBACK, LOOPBACK, LOOPBACK, (LOOPBACK,) * 3, f"{LOOPBACK}/32", "")


def detect() -> Layout:
    """Choose the best layout that this system can do."""
    return Layout() if is_free(0, Layout.proxy_inside) else NAMES_ONLY


@dataclass(frozen=True)
class Check:
    """A promise of the proxy, and whether the proxy kept the promise."""

    promise: str
    kept: bool
    detail: str


@dataclass
class Scenario:
    """Plays the acts. `checks`, `events` (time and text) and `act` show the progress."""

    seconds: float
    layout: Layout = field(default_factory=detect)
    checks: list[Check] = field(default_factory=list)
    events: list[tuple[float, str]] = field(default_factory=list)
    act: str = ""
    seen: dict[str, str] = field(default_factory=dict)
    began: float = field(default_factory=monotonic)

    def __post_init__(self) -> None:
        robot = self.layout.robot
        (first, second, third) = self.layout.inside
        self.master = FakeMaster(robot)
        self.talker = Talker("/inside/talker", first, "talker.inside", topic="/from_inside")
        self.listener = Listener(
            "/inside/listener", second, "listener.inside", topic="/from_outside"
        )
        self.adder = Adder("/inside/adder", third, "adder.inside", service="/inside/add")
        self.far_talker = Talker("/outside/talker", robot, topic="/from_outside")
        self.far_listener = Listener("/outside/listener", robot, topic="/from_inside")
        self.far_adder = Adder("/outside/adder", robot, service="/outside/add")
        self.inside: list[Actor] = [self.talker, self.listener, self.adder]
        self.outside: list[Actor] = [self.far_talker, self.far_listener, self.far_adder]
        self.nodes = [*self.inside, *self.outside]
        for pid, node in enumerate(self.nodes, 101):
            node.pid = pid
        for node in self.inside:
            node.slave.admits = node.tcpros.admits = self.layout.admits
        self.ros2 = Ros2Acts(robot, (first, second), self.layout.admits)
        self.proxy = ProxyProcess()
        self.first_port = free_ports(LEASES + 2)
        self.inside_master = f"http://{self.layout.proxy_inside}:{self.first_port}/"
        self.cut: dict[Talker, int] = {}
        self._talking: dict[AnyTalker, asyncio.Task[None]] = {}

    @property
    def ok(self) -> bool:
        """Whether all checks passed."""
        return all(check.kept for check in self.checks)

    @property
    def pairs(self) -> dict[tuple[str, str], tuple[AnyTalker, AnyListener]]:
        """Talker and listener, by version of ROS and direction."""
        outwards = "inside to outside"
        inwards = "outside to inside"
        ros2 = self.ros2
        return {
            ("ROS 1", outwards): (self.talker, self.far_listener),
            ("ROS 1", inwards): (self.far_talker, self.listener),
            ("ROS 2", outwards): (ros2.talker, ros2.far_listener),
            ("ROS 2", inwards): (ros2.far_talker, ros2.listener),
        }

    def clock(self) -> float:
        """The seconds since the demonstration began."""
        return monotonic() - self.began

    def tell(self, text: str) -> None:
        """Note that something happened now."""
        self.events.append((self.clock(), text))

    async def play(self) -> None:
        """Play all acts. A failure that ends the demonstration early is a failed check."""
        async with AsyncExitStack() as ending:
            try:
                await self._play(ending)
            except (DemoError, *CALL_ERRORS) as problem:
                detail = in_words(problem)
                self._check("the demonstration runs to its end", False, detail)
                self.tell(f"stopped: {detail}")
            self.act = "done"

    async def _play(self, ending: AsyncExitStack) -> None:
        await self._start_outside(ending)
        await self._try_without_proxy()
        await self._connect_through_proxy()
        await self._traffic_until(self.seconds * 0.5)
        calls = await self._call_both_ways()
        self._check("ROS 1: service calls cross both ways before the kill", *calls)
        addresses = await self._addresses_of_inside(), self.ros2.addresses()
        await self._kill_and_restart()
        self._check_addresses("ROS 1", addresses[0], await self._addresses_of_inside())
        self._check_addresses("ROS 2", addresses[1], self.ros2.addresses())
        await self._traffic_until(self.seconds - 0.7)
        calls = await self._call_both_ways()
        self._check("ROS 1: service calls cross both ways after the restart", *calls)
        await self._count()

    async def _start_outside(self, ending: AsyncExitStack) -> None:
        self.act = "the master and the outside nodes start"
        if not self.layout.outside_network:
            self.tell("no 127.0.2.x addresses here: the sides are separated by host names alone")
        await self.master.start()
        ending.push_async_callback(self.master.stop)
        self.tell(f"ROS master at {self.master.uri}, outside")
        ending.push_async_callback(self.ros2.stop)
        await self.ros2.start()
        self.tell(f"ROS 2 nodes in domain {self.ros2.domain}, no master")
        ending.push_async_callback(self.proxy.stop)
        for node in self.nodes:
            await node.start()
            ending.push_async_callback(node.stop)
        ending.callback(self._fall_silent)
        for node in self.outside:
            await node.register(self.master.uri)
        self._let_talk(self.far_talker)
        self._let_talk(self.ros2.far_talker)

    async def _try_without_proxy(self) -> None:
        self.act = "without rosproxy: inside registers at the master"
        talker = self.talker
        listener = self.far_listener
        await talker.register(self.master.uri)
        self._let_talk(talker)
        self._let_talk(self.ros2.talker)
        if self.layout.outside_network:
            self.ros2.announce_directly()
            await self._until(lambda: self.ros2.talker.turned_away, "ROS 2: the direct attempt")
        await self._until(lambda: listener.problem, "the direct attempt")
        await asyncio.sleep(min(1.0, self.seconds / 10))
        told = f"{talker.uri}: {listener.problem}"
        reached = bool(listener.received)
        if self.layout.outside_network:
            address = f"{talker.address}:{talker.slave.address[1]}"
            with suppress(*CALL_ERRORS):
                await listener.ask(f"http://{address}/", "getPid")
                reached = True
            told += f"; {address}: {'reached' if reached else 'turned away'}"
        self.tell(f"without rosproxy: {told}")
        self._check("ROS 1: without the proxy nothing crosses", not reached, told)
        self._check_ros2_without_proxy()
        await talker.call(self.master.uri, "unregisterPublisher", talker.topic, talker.uri)
        self._talking.pop(talker).cancel()

    def _check_ros2_without_proxy(self) -> None:
        """Check that discovery and messages stayed inside, unless the sides share an address."""
        if not self.layout.outside_network:
            return
        inside = self.ros2.talker
        received = self.ros2.far_listener.received
        told = f"{inside.locators[0]}: {inside.turned_away} datagrams turned away"
        self.tell(f"ROS 2 without rosproxy: {told}")
        self._check("ROS 2: without the proxy nothing crosses", not received, told)

    def proxy_options(self) -> list[str]:
        """The command line of the proxy."""
        first = self.first_port
        return [
            f"--master-uri={self.master.uri}",
            f"--advertise-host={self.layout.host}",
            f"--inside-network={self.layout.inside_network}",
            f"--master-port={first}",
            f"--admin-bind={LOOPBACK}:{first + 1}",
            f"--port-range={first + 2}-{first + 1 + LEASES}",
            "--data-plane=splice",
            *self.ros2.proxy_options(),
        ]

    async def _connect_through_proxy(self) -> None:
        self.act = "rosproxy and the inside nodes start"
        self.proxy.options = self.proxy_options()
        self.tell(f"rosproxy ready {await self.proxy.start():.2f} s after its start")
        for node in self.inside:
            await node.register(self.inside_master)
        self.seen = {node.name: f"{node.host}:{node.slave.address[1]}" for node in self.outside}
        self.seen |= await self._addresses_of_inside()
        self._let_talk(self.talker)
        listeners = self.listener, self.far_listener
        await self._until(
            lambda: all(listener.received for listener in listeners), "both sides hear"
        )
        self.tell("ROS 1: both listeners hear the other side")
        await self._call_both_ways()
        discovery = HostPort(self.layout.host, self.first_port + 2)
        self.ros2.announce_to_proxy(self.layout.proxy_inside, discovery)
        ready = monotonic()
        await self._until(lambda: self.ros2.is_connected(ready), "ROS 2: both sides hear")
        self.tell("ROS 2: both listeners hear the other side")

    async def _traffic_until(self, moment: float) -> None:
        self.act = "messages cross the boundary in both directions"
        await asyncio.sleep(max(1.0, moment - self.clock()))

    async def _call_both_ways(self) -> tuple[bool, str]:
        """Call the service of each side from the other side."""
        told = []
        for way, caller, master, service in (
            ("outside calls inside", self.far_listener, self.master.uri, self.adder.service),
            ("inside calls outside", self.listener, self.inside_master, self.far_adder.service),
        ):
            try:
                result = f"2 + 3 = {await caller.add(master, service, 2, 3)}"
            except CALL_ERRORS as problem:
                result = in_words(problem)
            told.append(f"{way}: {result}")
        self.tell(f"ROS 1: {', '.join(told)}")
        return all(outcome.endswith(": 2 + 3 = 5") for outcome in told), ", ".join(told)

    async def _addresses_of_inside(self) -> dict[str, str]:
        """The outside address of each inside node, checked by the pid that answers there."""
        addresses = {}
        for node in self.inside:
            uri = await self.far_listener.ask(self.master.uri, "lookupNode", node.name)
            pid = await self.far_listener.ask(uri, "getPid")
            host, port = host_and_port(uri)
            addresses[node.name] = f"{host}:{port}" + ("" if pid == node.pid else " (another node)")
        return addresses

    async def _kill_and_restart(self) -> None:
        """Kill and restart the proxy, and wait until all works as before."""
        self.act = "SIGKILL; no node is restarted"
        self.cut = {talker: talker.connections for talker in (self.talker, self.far_talker)}
        killed = monotonic()
        await self.proxy.kill()
        self.tell("rosproxy killed with SIGKILL")
        await asyncio.sleep(min(1.5, self.seconds / 10))
        heard = len(self.far_listener.received), len(self.ros2.listener.received)
        self.act = "restart: same command, no state on disk"
        self.tell(f"rosproxy ready {await self.proxy.start():.2f} s after its start")
        ready = monotonic()
        received = self.far_listener.received
        await self._until(lambda: len(received) > heard[0], "messages flow again")
        await self._until(self._service_answers, "the service answers again")
        took = {"message": received[heard[0]][1] - ready, "service call": monotonic() - ready}
        self._tell_recovery("ROS 1", took, ready - killed)
        await self._until(
            lambda: len(self.ros2.listener.received) > heard[1], "ROS 2: messages flow again"
        )
        await self._until(lambda: self.ros2.are_heard(ready), "ROS 2: outside hears of inside")
        took = {"message": self.ros2.listener.received[heard[1]][1] - ready}
        self._tell_recovery("ROS 2", took, ready - killed)

    def _tell_recovery(self, ros: str, took: dict[str, float], away: float) -> None:
        """Report the seconds until each thing worked again after an outage of `away` seconds."""
        slowest = max(took.values())
        times = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in took.items())
        self.tell(f"{ros}: {times} later; outage {away + slowest:.2f} s")

    async def _service_answers(self) -> bool:
        """Whether outside gets an answer of the inside adder."""
        with suppress(*CALL_ERRORS):
            await self.far_listener.add(self.master.uri, self.adder.service, 20, 22)
            return True
        return False

    def _check_addresses(self, ros: str, before: dict[str, str], after: dict[str, str]) -> None:
        told = [", ".join(map(" ".join, addresses.items())) for addresses in (before, after)]
        same = before == after and "another" not in told[0]
        detail = told[0] if same else f"before the kill: {told[0]}; afterwards: {told[1]}"
        self._check(f"{ros}: the same ports serve the same nodes", same, detail)

    async def _count(self) -> None:
        self.act = "the talkers stop; counting"
        self._fall_silent()
        # TCP connections end with the proxy and lose the messages on the way. A DDS writer resends.
        counts = {
            which: (talker, listener, self._sent_before_the_kill(talker))
            for which, (talker, listener) in self.pairs.items()
        }
        with suppress(DemoError):  # the count shows the missing messages
            await self._until(
                lambda: all(count(*flow)[0] for flow in counts.values()), "all arrive"
            )
        await asyncio.sleep(0.2)  # time for duplicates to arrive
        for (ros, way), flow in counts.items():
            self._check(f"{ros}: every message {way} arrived once", *count(*flow))

    def _sent_before_the_kill(self, talker: AnyTalker) -> frozenset[int]:
        """The numbers that a ROS 1 talker sent over connections that ended with the proxy."""
        if not isinstance(talker, Talker):
            return frozenset()
        cut = self.cut[talker]
        return frozenset(number for number, last in talker.sent_over.items() if last <= cut)

    def _check(self, promise: str, kept: bool, detail: str) -> None:
        self.checks.append(Check(promise, kept, detail))

    def _let_talk(self, talker: AnyTalker) -> None:
        self._talking[talker] = asyncio.create_task(talker.talk())

    def _fall_silent(self) -> None:
        for task in self._talking.values():
            task.cancel()

    async def _until(self, condition: Callable[[], Any], expectation: str) -> None:
        """Wait for a condition, maybe a coroutine function. Raises DemoError after PATIENCE."""
        end = monotonic() + PATIENCE
        while True:
            result = condition()
            if await result if isinstance(result, Awaitable) else result:
                return
            if monotonic() > end:
                raise DemoError(f"{expectation}: not within {PATIENCE:g} s")
            await asyncio.sleep(0.01)


def count(
    talker: AnyTalker, listener: AnyListener, before: frozenset[int] = frozenset()
) -> tuple[bool, str]:
    """Whether each message arrived once, except messages on the way when the proxy was killed.

    Numbers in `before` were sent over connections of the killed proxy. Only the last of these may
    be missing, because a connection keeps the order.
    """
    received = [number for number, _ in listener.received]
    missing = talker.sent.keys() - {*received}
    last = max(before & {*received}, default=0)
    cut_off = {number for number in missing & before if number > last}
    lost = len(missing - cut_off)
    twice = len(received) - len({*received})
    strange = {*received} - talker.sent.keys()
    told = f"sent {len(talker.sent)}, received {len(received)}"
    if cut_off:
        told += f", {len(cut_off)} on the way when the proxy was killed"
    if unheard := talker.number - len(talker.sent):
        told += f", {unheard} published while no subscriber was connected"
    told += f"; lost {lost}, duplicated {twice}"
    return bool(received) and not (lost or twice or strange), told
