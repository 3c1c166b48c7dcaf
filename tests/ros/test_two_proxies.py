"""Two proxies, in a row or each for a separate network, with a single master outside.

No network has a way to another but through the proxies: c1 is behind px, c2 behind px2.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import pytest

from tests.ros.combinations import LIBRARIES, each_library
from tests.ros.forks import Forks
from tests.ros.lab import MASTER_URI, Lab
from tests.ros.processes import Process, stop_all
from tests.ros.topology import (
    MASTER_PORT,
    OUT_HOST,
    SPLIT,
    Plan,
    PortMap,
    SecondProxy,
    Topology,
)

pytestmark = pytest.mark.boundary

PORTS = PortMap(47000, 47029, 47000)
BESIDE = replace(SPLIT, name="x", isolated=True, hairpin=True, second=SecondProxy((2,), PORTS))
IN_A_ROW = replace(SPLIT, name="y", isolated=True, second=SecondProxy((1, 2), PORTS))


class Second:
    """The proxy on px2."""

    def __init__(self, lab: Lab) -> None:
        self._lab = lab
        self._master = MASTER_URI
        self._host = OUT_HOST
        if lab.topology.plan == IN_A_ROW:
            self._master = f"http://{lab.place('px').address}:{MASTER_PORT}"
            self._host = lab.place("px2").address
        self.process = self._start()

    def _start(self) -> Process:
        argv = [sys.executable, "-m", "rosproxy", "run", "--master-uri", self._master]
        argv += ["--advertise-host", self._host, "--port-range", PORTS.bound]
        argv += ["--direction", "both", "--udp"]
        process = self._lab.spawn_proxy("px2", argv)
        process.wait_for("listening: ")
        return process

    def restart(self) -> None:
        """Kills and restarts the proxy."""
        self.process.kill()
        self.process = self._start()

    def stop(self) -> None:
        """Ends it."""
        stop_all([self.process])


@pytest.fixture(scope="module", params=[BESIDE, IN_A_ROW], ids=["beside", "in-a-row"])
def module_lab(
    request: pytest.FixtureRequest,
    topology_of: Callable[[Plan], Topology],
    forks: Forks,
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Lab]:
    """A master outside and the proxy on px, in each of the two networks in turn."""
    lab = Lab(topology_of(request.param), tmp_path_factory.mktemp("lab"), forks)
    lab.proxy_options = ("--udp",)
    yield lab
    lab.stop()


@pytest.fixture
def second(lab: Lab) -> Iterator[Second]:
    """The proxy on px2."""
    second = Second(lab)
    yield second
    log = second.process.output()
    print(log)
    assert second.process.returncode is None, log
    assert "Traceback" not in log, log
    second.stop()


mixed = pytest.mark.parametrize(
    ("library", "peer"), [LIBRARIES, LIBRARIES[::-1]], ids=["rospy-to-roscpp", "roscpp-to-rospy"]
)
ways = pytest.mark.parametrize(
    ("source", "sink"),
    [("c1", "c2"), ("c2", "c1"), ("c2", "out"), ("out", "c2")],
    ids=["first-to-second", "second-to-first", "second-to-outside", "outside-to-second"],
)


@ways
@mixed
def test_topics(lab: Lab, second: Second, library: str, peer: str, source: str, sink: str) -> None:
    topic = f"/{lab.unique('topic')}"
    lab.node(library, source, "pub", topic=topic)
    receiver = lab.node(peer, sink, "sub", topic=topic)
    receiver.wait_for_count("^got hello ", 5)


@ways
@mixed
def test_services(
    lab: Lab, second: Second, library: str, peer: str, source: str, sink: str
) -> None:
    service = f"/{lab.unique('service')}"
    caller = lab.node(library, sink, "call", service=service)
    lab.node(peer, source, "serve", service=service)
    caller.wait_for("^reply ask 0 ")


@pytest.mark.parametrize(
    ("source", "sink"), [("c2", "out"), ("out", "c2")], ids=["outwards", "inwards"]
)
def test_topics_by_udp(lab: Lab, second: Second, source: str, sink: str) -> None:
    topic = f"/{lab.unique('udp')}"
    lab.node("roscpp", source, "pub", topic=topic, rate=50)
    receiver = lab.node("roscpp", sink, "sub", topic=topic, udp=1)
    receiver.wait_for_count("^got hello ", 20)


@each_library
def test_tools_see_the_nodes_behind_both(lab: Lab, second: Second, library: str) -> None:
    nodes = {}
    for role in ("c1", "c2", "out"):
        name = lab.unique("subject")
        nodes[name] = lab.node(library, role, "pub", name=name, topic=f"/{name}/topic")
        nodes[name].wait_for("^sent ")
    for role in ("c1", "c2", "out"):
        for name, node in nodes.items():
            assert f"Pid: {node.pid}" in lab.run(role, "rosnode", "info", name).output
            lab.run(role, "rostopic", "echo", "-n", "1", f"/{name}/topic")
    lab.run("c1", "rosnode", "kill", *nodes)
    for name, node in nodes.items():
        node.wait(timeout=60)
        lab.wait_unregistered(name)


@pytest.mark.parametrize("killed", ["first", "second", "both"])
@each_library
def test_messages_flow_again_after_a_proxy_was_killed(
    lab: Lab, second: Second, library: str, killed: str
) -> None:
    topic = f"/{lab.unique('topic')}"
    places = ("c1", "c2", "out")
    receivers = [lab.node(library, role, "sub", topic=topic) for role in places]
    for receiver in receivers:
        receiver.wait_for("^ready")
    for role in places:
        lab.node(library, role, "pub", topic=topic, word=f"from-{role}")
    hears_all(receivers, places)
    if killed != "second":
        assert lab.proxy is not None
        lab.proxy.kill()
        lab.start_proxy()
    if killed != "first":
        second.restart()
    hears_all(receivers, places)


def hears_all(receivers: Iterable[Process], places: Iterable[str]) -> None:
    """Waits until each subscriber gets more messages from each place."""
    for receiver, role in itertools.product(receivers, places):
        receiver.wait_for_count(f"^got from-{role} ", 5, since=receiver.mark())
