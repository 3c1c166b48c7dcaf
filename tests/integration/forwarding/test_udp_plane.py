"""The kernel plane of ROS 2 with a kernel made up: what is forwarded, and what is counted."""

from collections.abc import AsyncIterator, Callable

import pytest

from rosproxy.forwarding.kernel import syncer
from rosproxy.forwarding.kernel.datagram_table import DatagramTable
from rosproxy.forwarding.kernel.decisions import HostForwarding
from rosproxy.forwarding.kernel.plane import KernelPlane
from rosproxy.forwarding.kernel.table import KernelTable
from rosproxy.forwarding.kernel.tools import ToolError
from rosproxy.ros2.domain_settings import DomainSettings, Refused
from rosproxy.ros2.ports.kernel_ports import KernelPorts
from rosproxy.ros2.ports.locator_ports import LocatorPorts
from rosproxy.ros2.ports.mappings import PortMappings
from rosproxy.ros2.protocol.rtps import FAST_DDS
from rosproxy.ros2.registry.participants import InsideParticipant, PortMapping, TrafficKind
from rosproxy.ros2.sources.address_proofs import AddressProofs
from rosproxy.runtime import Runtime
from rosproxy.shared.addresses import HostPort, Route
from rosproxy.shared.ports import PortMap, PortPool, PortRange
from tests.integration.kernel_fake import OWN, FakeTools, clear_the_way
from tests.integration.net import until
from tests.run_options import parse_settings

RANGE = PortRange(45000, 45015)
LOCATOR = HostPort("192.0.2.5", 7411)
OTHER = HostPort("192.0.2.6", 7411)


class Bench:
    """A UDP plane with a fake kernel, and the ports of a domain. No program listens."""

    def __init__(self, tools: FakeTools | None = None) -> None:
        told = {"ros": ("2",), "advertise_host": "192.0.2.1", "port_range": str(RANGE)}
        self.runtime = runtime = Runtime(parse_settings(told))
        self.tools = tools or FakeTools()
        self.later = 0.0
        ports = PortMap(RANGE, RANGE)
        pool = PortPool(RANGE)
        domain = DomainSettings(
            number=0,
            hosts=("192.0.2.1",),
            ports=ports,
            proxy_address_for=str,
            note=lambda *_: None,
            judge=lambda *_: True,
            is_inside=lambda _: True,
        )
        refused = Refused(domain.note)
        proofs = AddressProofs(b"a secret")
        self.mappings = PortMappings(domain, LocatorPorts(pool, 0.0), refused, proofs)
        self.kernel_ports = KernelPorts(pool)
        self.kernel_ports.domains.append(self.mappings)
        table = KernelTable(DatagramTable(RANGE), self.tools)
        self.plane = KernelPlane(
            runtime.settings,
            self.kernel_ports,
            runtime.tasks,
            runtime.problems,
            lambda: runtime.now() + self.later,
            table,
        )

    async def start(self) -> None:
        await self.plane.start()
        self.kernel_ports.note_former(self.plane.forwards)
        self.plane.recovered([])

    def map(self, locator: HostPort = LOCATOR, port: int = 45001) -> InsideParticipant:
        participant = InsideParticipant(bytes(12), locator.host, FAST_DDS, 0.0)
        self.mappings.add(participant, PortMapping(port, locator, TrafficKind.USER_DATA))
        self.plane.syncer.note_change()
        return participant

    def end(self, participant: InsideParticipant) -> None:
        self.mappings.end(participant)
        self.plane.syncer.note_change()

    async def forwarding(self, forwards: dict[int, HostPort]) -> None:
        wanted = {port: (locator.host, locator.port) for port, locator in forwards.items()}
        await until(lambda: self.tools.forwards == wanted, f"{forwards} are forwarded")

    @property
    def sources(self) -> dict[tuple[str, int], str]:
        """The source of what goes to each address and port."""
        return {
            (host, int(port)): source
            for target, source in (self.tools.table or {})["sources4"]
            for host, port in [target.split(" . ")]
        }

    async def close(self) -> None:
        await self.runtime.tasks.cancel()
        await self.plane.stop()


@pytest.fixture
def sound(monkeypatch: pytest.MonkeyPatch) -> None:
    """A network namespace in which nothing is in the way."""
    clear_the_way(monkeypatch)


@pytest.fixture
async def bench(sound: None) -> AsyncIterator[Bench]:
    bench = Bench()
    await bench.start()
    yield bench
    await bench.close()


async def test_a_lease_is_forwarded_while_it_is_there(bench: Bench) -> None:
    participant = bench.map()
    await bench.forwarding({45001: LOCATOR})
    (mapping,) = bench.kernel_ports
    await until(lambda: bench.plane.status_of(mapping)["plane"] == "kernel", "kernel plane")
    assert bench.sources == {(LOCATOR.host, LOCATOR.port): OWN}
    bench.end(participant)
    await bench.forwarding({})
    assert bench.sources == {}


async def test_a_port_follows_to_another_locator(bench: Bench) -> None:
    participant = bench.map()
    await bench.forwarding({45001: LOCATOR})
    bench.end(participant)
    bench.map(OTHER)
    await bench.forwarding({45001: OTHER})
    assert bench.sources == {(OTHER.host, OTHER.port): OWN}


async def test_another_address_of_the_proxy_is_followed(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.map()
    await bench.forwarding({45001: LOCATOR})
    monkeypatch.setattr(syncer, "route_towards", lambda address: Route("192.0.2.9", 1500))
    bench.later = syncer.ROUTE_AGE_S
    await bench.plane.look()
    await until(lambda: set(bench.sources.values()) == {"192.0.2.9"}, "the source is replaced")


async def test_a_locator_behind_a_shorter_mtu_stays_with_the_proxy(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(syncer, "read_forwarding", lambda: HostForwarding(longest_packet=9000))
    bench.plane.syncer.look_around()
    bench.map()
    (mapping,) = bench.kernel_ports
    assert "same MTU" in bench.plane.status_of(mapping)["reason"]
    assert bench.plane.status_of(mapping)["plane"] == "copy"


class NftAlone(FakeTools):
    """A machine without conntrack."""

    async def list_flows(self, take: Callable[[str], None], ipv6: bool, *which: str) -> None:
        """Fail."""
        raise ToolError("conntrack is not installed")

    async def forget_flows(self, ipv6: bool, *which: str) -> None:
        """Fail."""
        raise ToolError("conntrack is not installed")


async def test_datagrams_need_no_conntrack(sound: None, caplog: pytest.LogCaptureFixture) -> None:
    bench = Bench(NftAlone())
    await bench.start()
    bench.map()
    await bench.forwarding({45001: LOCATOR})
    await bench.plane.look()
    await bench.close()
    assert bench.tools.table is None
    assert "conntrack" not in caplog.text


async def test_datagrams_are_counted_and_need_no_answer(bench: Bench) -> None:
    bench.map()
    await bench.forwarding({45001: LOCATOR})
    bench.tools.counted = {"sent": 0, "received": 2028}
    for _ in range(4):
        await bench.plane.look()
        bench.tools.counted["received"] += 1000
    (mapping,) = bench.kernel_ports
    told = bench.plane.status_of(mapping)
    assert (told["plane"], told["received"], told["received_packets"]) == ("kernel", 5028, 1)
    assert bench.plane.total.received == 5028
    assert bench.plane.total.packets == 1


async def test_a_graceful_stop_resets_nobody_and_leaves_nothing(bench: Bench) -> None:
    bench.map()
    await bench.forwarding({45001: LOCATOR})
    await bench.close()
    assert bench.tools.table is None
    assert not any("reset" in document for document in bench.tools.documents)


async def test_what_a_killed_process_left_goes_on_for_a_while(bench: Bench) -> None:
    bench.map()
    bench.map(OTHER, 45002)
    await bench.forwarding({45001: LOCATOR, 45002: OTHER})
    later = Bench(bench.tools)
    await later.start()
    later.map(LOCATOR, 45003)
    await later.forwarding({45001: LOCATOR, 45002: OTHER, 45003: LOCATOR})
    later.map(LOCATOR, 45002)
    await later.forwarding({45001: LOCATOR, 45002: LOCATOR, 45003: LOCATOR})
    later.kernel_ports.note_former({})
    later.plane.syncer.note_change()
    await later.forwarding({45002: LOCATOR, 45003: LOCATOR})
    await later.runtime.tasks.cancel()


async def test_a_plane_that_is_lost_is_told_apart_from_that_for_topics(bench: Bench) -> None:
    bench.tools.failing = 2
    bench.map()
    await until(lambda: not bench.plane.syncer.usable, "the plane is lost")
    (problem,) = bench.runtime.problems.all()
    assert problem.subject == "data plane for UDP"
    assert bench.plane.status()["plane"] == "copy"
    assert bench.plane.forwards == {}
