"""The course of the demo, act by act; the evidence it gathers is judged by :mod:`.tally`."""

from __future__ import annotations

import asyncio
import time
import urllib.parse
from typing import Any

from rosproxy.demo import cast
from rosproxy.demo.board import Board, Entry
from rosproxy.demo.cast import ADD_INSIDE, ADD_OUTSIDE, ProxyPorts, Role
from rosproxy.demo.layout import Layout, free_ports
from rosproxy.demo.processes import DemoError, Processes, Supervised, Worker, until
from rosproxy.demo.tally import Evidence, count_stream, first_message_after

START_SECONDS = 15.0
"""How long anything may take to start; a slow machine is no reason to fail."""
RECOVERY_WAIT = 10.0
"""How long a recovery is waited for: longer than it may take, so that it can be measured."""
DIRECT_SECONDS = 1.0
LONGEST_OUTAGE = 1.5
SHORTEST_TRAFFIC = 1.0
ENDING_SECONDS = 0.7


class Course:
    """Runs the acts in order; `evidence` grows as they go, also when one of them fails."""

    def __init__(self, layout: Layout, processes: Processes, board: Board, seconds: float) -> None:
        self.evidence = Evidence()
        self._layout = layout
        self._processes = processes
        self._board = board
        self._seconds = seconds
        self._ports = ProxyPorts(0)
        self._master_uri = ""
        self._workers: dict[Role, Worker] = {}
        self._proxy: Supervised | None = None
        self._killed = self._restarted = 0.0

    async def run(self) -> None:
        """Run the demo; raises DemoError when it can't go on."""
        await self._start_outside()
        await self._try_without_proxy()
        await self._start_inside()
        await self._traffic_until(self._seconds * 0.5)
        self.evidence.service_before += await self._call_both_ways()
        self.evidence.addresses_before = await self._inside_addresses()
        await self._kill_and_restart()
        await self._recover()
        await self._traffic_until(self._seconds - ENDING_SECONDS)
        self.evidence.service_after += await self._call_both_ways()
        await self._finish()

    # Acts

    async def _start_outside(self) -> None:
        self._board.enter("the master and the outside nodes start")
        if self._layout.note:
            self._board.tell(self._layout.note)
        master = await self._processes.worker("master", cast.master_config(self._layout))
        await until(lambda: master.state, START_SECONDS, "the master starts")
        self._master_uri = master.state["uri"]
        self._board.tell(f"ROS master at {self._master_uri}, outside")
        await self._start_nodes(cast.OUTSIDE, self._master_uri)

    async def _try_without_proxy(self) -> None:
        self._board.enter("without rosproxy: inside registers at the master")
        await self._start_nodes((cast.INSIDE_TALKER,), self._master_uri)
        listener = self._workers[cast.OUTSIDE_LISTENER]
        await until(lambda: _heard(listener)["problem"], START_SECONDS, "the direct attempt")
        await asyncio.sleep(min(DIRECT_SECONDS, self._seconds / 10))
        talker = self._workers[cast.INSIDE_TALKER]
        self.evidence.direct_received = _heard(listener)["count"]
        self.evidence.direct_problem = await self._why_direct_fails(listener, talker)
        self._board.tell(f"without rosproxy: {self.evidence.direct_problem}")
        await talker.stop()

    async def _why_direct_fails(self, listener: Worker, talker: Worker) -> str:
        """Put the failure into words; tries the bare address too, which must not work either."""
        uri = talker.state["uri"]
        problem = f"{uri} -> {_heard(listener)['problem']}"
        address = cast.place_of(cast.INSIDE_TALKER, self._layout).address
        if self._layout.note:
            return problem
        port = urllib.parse.urlsplit(uri).port
        answer = await listener.request("reach", host=address, port=port)
        if "error" not in answer:
            return ""
        return f"{problem}; {address}:{port} -> {answer['error']}"

    async def _start_inside(self) -> None:
        self._board.enter("rosproxy and the inside nodes start")
        self._ports = ProxyPorts(0)
        self._ports = ProxyPorts(free_ports(self._ports.count))
        await self._start_proxy()
        uri = f"http://{self._layout.proxy_inside}:{self._ports.master}/"
        await self._start_nodes(cast.INSIDE, uri)
        await until(self._connected, START_SECONDS, "the listeners connect")
        await self._show_addresses()
        self._board.tell("both listeners hear the other side")
        self.evidence.service_before += await self._call_both_ways()

    async def _traffic_until(self, moment: float) -> None:
        """Let messages flow until `moment` on the demo's clock, and at least for a while."""
        self._board.enter("messages cross the boundary in both directions")
        await asyncio.sleep(max(SHORTEST_TRAFFIC, moment - self._board.clock()))

    async def _kill_and_restart(self) -> None:
        self._board.enter("SIGKILL; no node is restarted")
        proxy = self._running_proxy()
        self._killed = time.monotonic()
        await proxy.kill()
        self._board.proxy = "killed"
        self._board.tell("rosproxy killed with SIGKILL")
        await asyncio.sleep(min(LONGEST_OUTAGE, self._seconds / 10))
        self._board.enter("restart: same command, no state on disk")
        self._restarted = time.monotonic()
        await self._start_proxy()

    async def _recover(self) -> None:
        calls = asyncio.create_task(self._call_until_answered())
        try:
            await until(self._first_message, RECOVERY_WAIT, "messages flow again")
            await until(calls.done, RECOVERY_WAIT, "the service answers again")
        finally:
            calls.cancel()
        self._note_recovery(calls.result())
        self.evidence.service_after += await self._call_both_ways()
        self.evidence.addresses_after = await self._inside_addresses()

    async def _finish(self) -> None:
        self._board.enter("the talkers stop; counting")
        talkers = (cast.INSIDE_TALKER, cast.OUTSIDE_TALKER)
        await asyncio.gather(*(self._workers[role].request("pause") for role in talkers))
        await asyncio.sleep(0.2)
        reports = await asyncio.gather(*(one.request("report") for one in self._workers.values()))
        state = {role: report["state"] for role, report in zip(self._workers, reports, strict=True)}
        pairs = (
            ("inside to outside", cast.INSIDE_TALKER, cast.OUTSIDE_LISTENER),
            ("outside to inside", cast.OUTSIDE_TALKER, cast.INSIDE_LISTENER),
        )
        self.evidence.streams = tuple(
            count_stream(
                direction,
                state[talker]["publisher"],
                state[listener]["subscription"],
                self._killed,
            )
            for direction, talker, listener in pairs
        )
        # The nodes first: they unregister through the proxy.
        await asyncio.gather(*(worker.stop() for worker in self._workers.values()))
        await self._running_proxy().stop()
        self._board.proxy = "stopped"
        self._board.enter("done")

    # Steps

    def _running_proxy(self) -> Supervised:
        """Return the proxy; raises DemoError if it is gone without having been killed here."""
        if self._proxy is None or not self._proxy.running:
            raise DemoError("the proxy ended by itself")
        return self._proxy

    async def _start_nodes(self, roles: tuple[Role, ...], master_uri: str) -> None:
        for role in roles:
            config = cast.node_config(role, self._layout, master_uri)
            worker = await self._processes.worker(role.name, config)
            self._workers[role] = worker
            self._board.entries[role.name] = Entry(role.side, role.node, worker)
        await until(
            lambda: all(self._workers[role].state.get("registered") for role in roles),
            START_SECONDS,
            f"{', '.join(role.name for role in roles)} register",
        )

    async def _start_proxy(self) -> None:
        self._board.proxy = "starting"
        options = cast.proxy_options(self._layout, self._ports, self._master_uri)
        began = time.monotonic()
        self._proxy = await self._processes.proxy(options)
        while not await _ready(self._ports.admin):
            if not self._proxy.running:
                raise DemoError("the proxy ended instead of starting")
            if time.monotonic() > began + START_SECONDS:
                raise DemoError("the proxy isn't ready")
            await asyncio.sleep(0.02)
        self._board.proxy = "ready"
        self._board.tell(f"rosproxy ready {time.monotonic() - began:.2f} s after its start")

    def _connected(self) -> bool:
        listeners = (cast.INSIDE_LISTENER, cast.OUTSIDE_LISTENER)
        return all(_heard(self._workers[role])["count"] for role in listeners)

    def _first_message(self) -> float | None:
        return first_message_after(_heard(self._workers[cast.OUTSIDE_LISTENER]), self._killed)

    async def _call_until_answered(self) -> float:
        """Call the inside service from outside until it answers; return when it did."""
        caller = self._workers[cast.OUTSIDE_LISTENER]
        while True:
            answer = await caller.request("call", service=ADD_INSIDE, a=20, b=22)
            if answer.get("sum") == 42:
                return float(answer["time"])
            await asyncio.sleep(0.02)

    def _note_recovery(self, answered: float) -> None:
        first = self._first_message() or 0.0
        self.evidence.message_recovery = first - self._restarted
        self.evidence.service_recovery = answered - self._restarted
        self._board.tell(
            f"first message {first - self._restarted:.2f} s after the restart,"
            f" first service call {answered - self._restarted:.2f} s;"
            f" the whole outage took {max(first, answered) - self._killed:.2f} s"
        )

    async def _call_both_ways(self) -> tuple[str, ...]:
        """Call each side's service from the other; return the two problems, empty if none."""
        ways = {
            "outside calls inside": (cast.OUTSIDE_LISTENER, ADD_INSIDE),
            "inside calls outside": (cast.INSIDE_LISTENER, ADD_OUTSIDE),
        }
        results = {way: await self._call(*who) for way, who in ways.items()}
        told = ", ".join(f"{way}: {result}" for way, result in results.items())
        self._board.tell(f"service calls, {told}")
        right = "2 + 3 = 5"
        return tuple(
            "" if result == right else f"{way}: {result}" for way, result in results.items()
        )

    async def _call(self, caller: Role, service: str) -> str:
        answer = await self._workers[caller].request("call", service=service, a=2, b=3)
        return f"2 + 3 = {answer['sum']}" if "sum" in answer else str(answer["error"])

    async def _inside_addresses(self) -> dict[str, str]:
        """Return where outside finds each inside node.

        Outside looks the nodes up and asks what answers there for its process id: a node that
        isn't the right one is left out, with the problem in the place of its address.
        """
        names = [role.name for role in cast.INSIDE]
        answer = await self._workers[cast.OUTSIDE_LISTENER].request("identify", names=names)
        if "error" in answer:
            return {"error": answer["error"]}
        found: dict[str, dict[str, Any]] = answer["nodes"]
        return {
            role.name: _identity(found[role.name], self._workers[role].process.pid)
            for role in cast.INSIDE
        }

    async def _show_addresses(self) -> None:
        """Put on the board what each side gets to see of the other."""
        for viewer, roles in (
            (cast.OUTSIDE_LISTENER, cast.INSIDE),
            (cast.INSIDE_LISTENER, cast.OUTSIDE),
        ):
            names = [role.name for role in roles]
            answer = await self._workers[viewer].request("identify", names=names)
            for name, found in answer.get("nodes", {}).items():
                self._board.entries[name].seen = _address(found["uri"])


def _heard(listener: Worker) -> dict[str, Any]:
    """Return what a listener last reported of its subscription."""
    nothing: dict[str, Any] = {"count": 0, "problem": "", "links": []}
    return listener.state.get("subscription") or nothing


def _address(uri: str) -> str:
    return urllib.parse.urlsplit(uri).netloc


def _identity(found: dict[str, Any], pid: int) -> str:
    """Return the address of a looked-up node, or what is wrong with it."""
    if found["pid"] == pid:
        return _address(found["uri"])
    return f"{_address(found['uri'])} is another process: {found.get('error', found['pid'])}"


async def _ready(port: int) -> bool:
    """Tell whether the proxy's admin endpoint says that it is ready."""
    try:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
    except OSError:
        return False
    try:
        writer.write(b"GET /readyz HTTP/1.0\r\n\r\n")
        status = await asyncio.wait_for(reader.readline(), 2.0)
    except (OSError, TimeoutError):
        return False
    finally:
        writer.close()
    return b" 200 " in status
