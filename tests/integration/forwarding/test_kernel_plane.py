"""The kernel plane with a fake kernel: behaviour after faults."""

import asyncio
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

from rosproxy.forwarding import fast_ports
from rosproxy.forwarding.fast_ports import BothSides
from rosproxy.forwarding.kernel import plane as kernel_plane
from rosproxy.forwarding.kernel import syncer
from rosproxy.forwarding.kernel.connection_table import ConnectionTable, Marks
from rosproxy.forwarding.kernel.plane import KernelPlane
from rosproxy.forwarding.kernel.table import TrackedTable
from rosproxy.ros1.context import Context
from rosproxy.ros1.registry.endpoint import Endpoint, NodeLocation
from rosproxy.ros1.registry.stand_ins import StandIn
from rosproxy.runtime import Runtime
from rosproxy.shared.addresses import HostPort
from tests.integration.kernel_fake import FakeTools, clear_the_way
from tests.integration.net import PATIENCE
from tests.run_options import parse_settings

NODE = "192.0.2.5"
FLOW = (
    "tcp 6 431999 {state} src=198.51.100.2 dst=192.0.2.1 sport=1 dport={port} "
    "src=192.0.2.5 dst=192.0.2.1 sport=50000 dport=1 [ASSURED] mark={mark} use=1\n"
)


def settings(mode: str) -> dict[str, Any]:
    return {
        "master_uri": "http://robot:11311",
        "advertise_host": "host",
        "port_range": "45000-45003",
        "master_port": 11311,
        "bind": "127.0.0.1",
        "admin_bind": "127.0.0.1:11312",
        "slave_control": "any",
        "data_plane": mode,
        "direction": "both",
        "inside_network": ("172.30.0.0/16",),
        "probe_interval": 5.0,
        "probe_timeout": 3.0,
        "cleanup_after": 30.0,
        "linger": 30.0,
        "master_interval": 2.0,
    }


class Bench:
    """A plane over a made-up kernel; nothing listens."""

    def __init__(self, mode: str = "auto", tools: FakeTools | None = None) -> None:
        self.context = Context(Runtime(parse_settings(settings(mode))))
        self.tools = tools or FakeTools()
        self.later = 0.0
        self.plane = KernelPlane(
            self.context.settings,
            BothSides(self.context.registry, self.context.stand_ins.by_port),
            self.context.tasks,
            self.context.problems,
            lambda: self.context.now() + self.later,
            TrackedTable(ConnectionTable(11311, self.context.settings.ports.listen), self.tools),
            self.context.client_networks,
        )

    def node(self, number: int = 0, tcpros_port: int | None = 50000) -> Endpoint:
        node = HostPort(NODE, 40000 + number)
        endpoint = self.context.registry.admit(
            f"http://{node}/", node, NodeLocation(NODE, True), NODE
        )
        endpoint.topic_ports = {"/a": tcpros_port} if tcpros_port else {}
        return endpoint

    async def forwarded(self, number: int = 0) -> Endpoint:
        endpoint = self.node(number)
        assert fast_ports.claim(self.context.registry.pool, endpoint)
        assert await self.plane.syncer.forwards(endpoint, 50000)
        return endpoint

    def stand_in(self) -> StandIn:
        address = HostPort("robot", 40000)
        local = HostPort("172.30.0.2", 20016)
        uri = f"http://{address}/"
        stand_in = StandIn(local, uri, address, is_uri_kept=False, topic_ports={"/chatter": 50000})
        stand_in.address = NODE
        self.context.stand_ins.add(stand_in)
        assert stand_in.fast_candidate is not None
        self.context.stand_ins.note_fast_port(stand_in, stand_in.fast_candidate.port)
        return stand_in

    @property
    def near(self) -> list[str]:
        return (self.tools.table or {})["near4"]

    def flow(self, port: int, state: str = "ESTABLISHED") -> str:
        return FLOW.format(port=port, state=state, mark=Marks(11311).of(port))


@pytest.fixture
def sound(monkeypatch: pytest.MonkeyPatch) -> None:
    """A network namespace in which nothing is in the way."""
    clear_the_way(monkeypatch)


@pytest.fixture
async def bench(sound: None) -> AsyncIterator[Bench]:
    bench = Bench()
    await bench.plane.start()
    bench.plane.recovered([])
    yield bench
    await bench.context.tasks.cancel()
    await bench.plane.stop()


async def until(check: Callable[[], bool]) -> None:
    async with asyncio.timeout(PATIENCE):
        while not check():
            await asyncio.sleep(0.01)


async def test_an_endpoint_is_forwarded_when_it_is_asked_for(bench: Bench) -> None:
    endpoint = await bench.forwarded()
    assert bench.tools.forwards == {45002: (NODE, 50000)}
    told = bench.plane.status_of(endpoint)
    assert (told["plane"], told["port"], told["reason"]) == ("kernel", 45002, "")
    assert bench.plane.status() == {"mode": "auto", "plane": "kernel", "reason": ""}


async def test_another_tcpros_port_is_followed(bench: Bench) -> None:
    endpoint = await bench.forwarded()
    endpoint.topic_ports = {"/a": 50009}
    assert await bench.plane.syncer.forwards(endpoint, 50009)
    assert bench.tools.forwards == {45002: (NODE, 50009)}
    assert not await bench.plane.syncer.forwards(endpoint, 50000)


async def test_a_node_that_is_down_or_gone_is_not_forwarded(bench: Bench) -> None:
    endpoint = await bench.forwarded()
    other = await bench.forwarded(1)
    endpoint.health.end(1.0)
    bench.plane.syncer.note_change(endpoint)
    await bench.plane.syncer.wait_until_unforwarded(45002)
    assert set(bench.tools.forwards) == {45003}
    fast_ports.give_back(bench.context.registry.pool, other)
    bench.context.registry.remove(other)
    bench.plane.syncer.note_change(other)
    await bench.plane.syncer.wait_until_unforwarded(45003)
    assert bench.tools.forwards == {}
    assert bench.plane.status_of(endpoint)["reason"] == "the node does not answer"


async def test_only_those_that_changed_are_gone_through(bench: Bench) -> None:
    first = await bench.forwarded()
    second = await bench.forwarded(1)
    first.topic_ports = second.topic_ports = {"/a": 50001}
    assert await bench.plane.syncer.forwards(second, 50001)
    assert bench.tools.forwards == {45002: (NODE, 50000), 45003: (NODE, 50001)}
    await bench.plane.look()
    await until(lambda: bench.tools.forwards[45002] == (NODE, 50001))


async def test_a_node_on_the_proxys_own_machine_is_not_forwarded(bench: Bench) -> None:
    endpoint = bench.node()
    endpoint.location = NodeLocation("127.0.0.1", True)
    assert not bench.plane.syncer.may_forward(endpoint)
    assert not await bench.plane.syncer.forwards(endpoint, 50000)
    assert "the proxy itself" in bench.plane.status_of(endpoint)["reason"]


async def test_connections_and_bytes_are_taken_in(bench: Bench) -> None:
    endpoint = await bench.forwarded()
    bench.tools.flows = bench.flow(45002) + bench.flow(45002, "TIME_WAIT") + bench.flow(45003)
    await bench.plane.look()
    assert endpoint.fast_peers == {"198.51.100.2": 1}
    told = bench.plane.status_of(endpoint)
    assert (told["connections"], told["sent"], told["received"]) == (1, 1000, 1000)
    assert bench.plane.syncer.usable
    assert bench.plane.traffic.sent == {("node", "unnamed"): 1000}


async def test_a_node_outside_is_forwarded_to_those_who_may_use_the_proxy(bench: Bench) -> None:
    stand_in = bench.stand_in()
    assert bench.plane.syncer.may_forward(stand_in)
    assert await bench.plane.syncer.forwards(stand_in, 50000)
    assert bench.tools.forwards == {stand_in.fast_port: (NODE, 50000)}
    assert bench.tools.table is not None
    assert bench.tools.table["inward"] == [stand_in.fast_port]
    assert bench.tools.table["near4"] == ["172.30.0.0/16"]
    bench.context.selected = frozenset(["172.30.0.5", "172.30.0.4"])
    await bench.plane.look()
    await until(lambda: bench.near == ["172.30.0.4/31"])


async def test_what_goes_outside_is_counted_as_sent(bench: Bench) -> None:
    stand_in = bench.stand_in()
    assert await bench.plane.syncer.forwards(stand_in, 50000)
    bench.tools.flows = bench.flow(stand_in.port)
    bench.tools.counted = {"sent": 5000, "received": 70}
    await bench.plane.look()
    assert stand_in.fast_peers == {"198.51.100.2": 1}
    told = bench.plane.status_of(stand_in)
    assert (told["connections"], told["sent"], told["received"]) == (1, 70, 5000)
    assert bench.plane.traffic.sent == {("node", "robot"): 70}


async def test_a_stand_in_that_has_gone_is_not_forwarded(bench: Bench) -> None:
    stand_in = bench.stand_in()
    assert await bench.plane.syncer.forwards(stand_in, 50000)
    bench.context.stand_ins.remove(stand_in)
    bench.plane.syncer.note_change(stand_in)
    await bench.plane.syncer.wait_until_unforwarded(stand_in.port)
    assert bench.tools.forwards == {}


async def test_a_table_that_is_gone_is_made_again(bench: Bench) -> None:
    await bench.forwarded()
    bench.tools.table = None
    await bench.plane.look()
    assert bench.tools.forwards == {45002: (NODE, 50000)}
    bench.tools.table = None
    await bench.forwarded(1)
    assert set(bench.tools.forwards) == {45002, 45003}


async def test_what_somebody_else_changed_is_put_right(bench: Bench) -> None:
    await bench.forwarded()
    assert bench.tools.table is not None
    for name in ("marks", "hosts4", "ports"):
        bench.tools.table[name].clear()
    await bench.plane.look()
    await until(lambda: bench.tools.forwards == {45002: (NODE, 50000)})


async def test_a_plane_that_is_lost_is_told_and_comes_back(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(syncer, "LOST_TABLE_RETRY_S", 0.0)
    endpoint = await bench.forwarded()
    endpoint.fast_peers = {"198.51.100.2": 1}
    bench.tools.failing = 2
    endpoint.topic_ports = {"/a": 50001}
    assert not await bench.plane.syncer.forwards(endpoint, 50001)
    assert not bench.plane.syncer.usable
    assert endpoint.fast_peers == {}
    assert bench.plane.status()["plane"] in ("splice", "copy")
    assert "not permitted" in bench.context.problems.all()[0].text
    await bench.plane.look()
    assert bench.plane.status()["plane"] == "kernel"
    assert bench.context.problems.all() == []
    assert await bench.plane.syncer.forwards(endpoint, 50001)


async def test_a_plane_that_stays_lost_is_tried_again_later(bench: Bench) -> None:
    endpoint = await bench.forwarded()
    bench.tools.failing = 10
    endpoint.topic_ports = {"/a": 50001}
    assert not await bench.plane.syncer.forwards(endpoint, 50001)
    left = bench.tools.failing
    await bench.plane.look()
    assert bench.tools.failing == left


async def test_who_is_not_answered_gets_back_to_user_space(bench: Bench) -> None:
    endpoint = await bench.forwarded()
    bench.tools.flows = bench.flow(45002, "SYN_SENT")
    await bench.plane.look()
    assert bench.plane.syncer.may_forward(endpoint)
    bench.later = kernel_plane.UNANSWERED_TIMEOUT_S
    await bench.plane.look()
    assert bench.tools.forwards == {}
    waiting = False, ("--mark", Marks(11311).port_selector(45002), "--state", "SYN_SENT")
    assert waiting in bench.tools.forgotten
    assert "did not answer through the kernel" in bench.plane.status_of(endpoint)["reason"]
    bench.tools.flows = ""
    bench.later += 6
    assert await bench.plane.syncer.forwards(endpoint, 50000)


async def test_cutting_forgets_the_connections(bench: Bench) -> None:
    endpoint = await bench.forwarded()
    bench.plane.cut(endpoint)
    mark = Marks(11311).port_selector(45002)
    await until(lambda: bench.tools.forgotten == [(False, ("--mark", mark))])


async def test_stopping_leaves_nothing(bench: Bench) -> None:
    endpoint = await bench.forwarded()
    await bench.plane.stop()
    assert bench.tools.table is None
    marked = "--mark", Marks(11311).table_selector
    assert set(bench.tools.forgotten) == {(False, marked), (True, marked)}
    assert not await bench.plane.syncer.forwards(endpoint, 50001)


async def test_what_a_killed_process_left_goes_on_until_it_is_known_whose_it_is(
    bench: Bench,
) -> None:
    await bench.forwarded()
    later = Bench(tools=bench.tools)
    await later.plane.start()
    later.plane.syncer.note_change()
    await asyncio.sleep(0.05)
    assert later.tools.forwards == {45002: (NODE, 50000)}
    node = HostPort(NODE, 40000)
    place = NodeLocation(NODE, True, confirmed=False)
    endpoint = later.context.registry.restore(f"http://{node}/", node, place, 45000)
    assert endpoint is not None
    later.plane.recovered([endpoint])
    await asyncio.sleep(0.05)
    assert later.tools.forwards == {45002: (NODE, 50000)}
    endpoint.topic_ports = {"/a": 50001}
    endpoint.trusted = True
    assert await later.plane.syncer.forwards(endpoint, 50001)
    assert later.tools.forwards == {45002: (NODE, 50001)}
    assert later.plane.status_of(endpoint)["plane"] == "kernel"
    await later.context.tasks.cancel()


async def test_what_a_killed_process_left_ends_where_a_topic_may_be_denied(bench: Bench) -> None:
    """The table says nothing about topics, and the policy may have changed since."""
    await bench.forwarded()
    await bench.forwarded(1)
    later = Bench(tools=bench.tools)
    await later.plane.start()
    later.plane.cut_former(lambda port, host: port == 45002 and host == NODE)
    selector = "--mark", Marks(11311).port_selector(45002)
    await until(lambda: later.tools.forgotten == [(False, selector), (True, selector)])
    assert later.tools.forwards == {45003: (NODE, 50000)}
    later.plane.recovered([])
    await later.forwarded()  # the policy allows the topics again
    await later.context.tasks.cancel()


async def test_what_a_killed_process_left_of_a_known_node_goes_on(bench: Bench) -> None:
    """The policy has judged the node by its name, and denies it nothing."""
    await bench.forwarded()
    later = Bench(tools=bench.tools)
    await later.plane.start()
    later.plane.recovered([later.node()])
    await later.plane.syncer.cut_former(lambda port, host: True)
    assert later.tools.forgotten == []
    assert later.tools.forwards == {45002: (NODE, 50000)}
    await later.context.tasks.cancel()


async def test_a_lost_fast_port_is_cut_once(bench: Bench) -> None:
    endpoint = await bench.forwarded()
    fast_ports.give_back(bench.context.registry.pool, endpoint)
    bench.plane.syncer.note_change(endpoint)
    await bench.plane.syncer.wait_until_unforwarded(45002)
    assert endpoint in bench.plane.owners
    bench.tools.flows = bench.flow(45002)
    await bench.plane.look()
    assert endpoint.fast_peers == {"198.51.100.2": 1}
    bench.plane.cut(endpoint)
    assert endpoint not in bench.plane.owners
    await until(lambda: bool(bench.tools.forgotten))
    # Otherwise the proxy takes the subscribers for connected, and tells them no publisher.
    assert endpoint.fast_peers == {}
    assert bench.plane.status_of(endpoint)["sent"]


async def test_forwards_that_nobody_claims_are_removed(bench: Bench) -> None:
    await bench.forwarded()
    later = Bench(tools=bench.tools)
    await later.plane.start()
    later.plane.recovered([])
    await until(lambda: later.tools.forwards == {})
    await later.context.tasks.cancel()


@pytest.mark.parametrize(
    ("mode", "level", "problems"), [("auto", "INFO", 0), ("kernel", "ERROR", 1)]
)
async def test_what_is_missing_is_said(
    sound: None, caplog: pytest.LogCaptureFixture, mode: str, level: str, problems: int
) -> None:
    caplog.set_level("INFO")
    bench = Bench(mode)
    bench.tools.failing = 2
    await bench.plane.start()
    assert not bench.plane.syncer.usable
    assert caplog.records[-1].levelname == level
    assert "not permitted" in caplog.text
    reported = bench.context.problems.all()
    assert [problem.subject for problem in reported] == ["data plane"] * problems
    endpoint = bench.node()
    bench.plane.recovered([endpoint])
    assert endpoint.fast_port == 45002
    assert not await bench.plane.syncer.forwards(endpoint, 50000)
    assert bench.plane.status_of(endpoint)["port"] == 45002


async def test_a_kernel_without_limits_forwards_and_says_so(
    sound: None, caplog: pytest.LogCaptureFixture
) -> None:
    bench = Bench()
    bench.tools.lacking = "limit rate"
    await bench.plane.start()
    bench.plane.recovered([])
    await bench.forwarded()
    assert bench.plane.status()["plane"] == "kernel"
    (problem,) = bench.context.problems.all()
    assert "forged SYN packets" in problem.text
    assert "nft_limit" in problem.text
    assert problem.text in caplog.text
    bench.tools.lacking = ""
    await bench.plane.syncer.begin()
    assert "limit rate" in bench.tools.documents[-1]
    await bench.context.tasks.cancel()
    await bench.plane.stop()


@pytest.mark.parametrize("mode", ["splice", "copy"])
async def test_other_modes_leave_the_kernel_alone(mode: str) -> None:
    bench = Bench(mode)
    await bench.plane.start()
    endpoint = bench.node()
    bench.plane.recovered([endpoint])
    await bench.plane.look()
    assert bench.plane.status()["reason"] == f"data plane {mode}"
    await bench.plane.stop()
    assert endpoint.fast_port is None
    assert bench.tools.documents == []
