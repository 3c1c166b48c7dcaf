"""Whatever happens on a host, and wherever the controller is killed: it ends as it ought to.

A host that does everything that hosts do, see `Hosts`, and after each turn what must always hold.
From time to time nothing else happens: then the controller must come to rest, with everything as
wished.
"""

import contextlib
from typing import Any

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from rosproxy.core.ports import PortRange
from rosproxy_operator.core.actions import Action, CreateSandbox, Start
from rosproxy_operator.core.fingerprint import (
    ROLE_PROXY,
    ROLE_SANDBOX,
    Own,
    fingerprint,
    proxy_name,
    reserved_ports,
    sandbox_fingerprint,
    sandbox_name,
)
from rosproxy_operator.core.labels import read_wishes
from rosproxy_operator.core.memory import Memory
from rosproxy_operator.core.model import ALIVE, STARTED, Key, Wish
from rosproxy_operator.core.plan import Plan
from rosproxy_operator.core.ports import overlap
from rosproxy_operator.core.settings import PlanSettings
from tests.unit.operator.simulation import SERVING, Box, Controller, Engine, Failed, Refused

PORTS = st.integers(11400, 11415)
NAMES = st.sampled_from(["talker", "listener", "camera"])
NETWORKS = st.sampled_from(["app", "lab", "0-early", "inner", "0-inner"])
MASTERS = st.sampled_from(["http://robot:11311", "http://arm:11312", "http://192.0.2.9:11402"])
COUNTS = st.sampled_from(["1", "2", "3", "5", "nonsense"])
SETTINGS = PlanSettings(
    advertise_host="192.0.2.10", ports=2, window=PortRange(11400, 11415), grace=10.0
)
ROBOT = Key("http://robot:11311", "192.0.2.10")
EPHEMERAL = PortRange(11414, 11500)


class Hosts(RuleBasedStateMachine):
    """A host with labelled containers, a controller, and people who meddle."""

    def __init__(self) -> None:
        super().__init__()
        self.engine = Engine(SETTINGS, EPHEMERAL)
        self.controller = Controller(self.engine, SETTINGS)
        self.engine.add_network("app")
        self.served: dict[Key, PortRange] = {}
        self.may_move: set[Key] = set()

    def draw(self, data: st.DataObject, boxes: list[Box]) -> Box | None:
        return data.draw(st.sampled_from(boxes)) if boxes else None

    def own(self, *states: str, role: str = "") -> list[tuple[Box, Own]]:
        """The controller's containers."""
        return [
            (box, box.own)
            for box in self.engine.boxes
            if box.own and (not states or box.state in states) and role in ("", box.role)
        ]

    def boxes(self, *states: str, role: str = "") -> list[Box]:
        return [box for box, _ in self.own(*states, role=role)]

    # containers of users

    @rule(
        name=NAMES,
        master=MASTERS,
        count=COUNTS,
        network=NETWORKS,
        state=st.sampled_from(["running", "created", "exited"]),
        env=st.sampled_from(["", "http://rosproxy:11311", "http://robot:11311"]),
    )
    def run(self, name: str, master: str, count: str, network: str, state: str, env: str) -> None:
        if any(box.name == name for box in self.engine.boxes):
            return
        labels = {"rosproxy.enable": "true", "rosproxy.master-uri": master}
        box = self.engine.add(
            name, state=state, env=env, labels={**labels, "rosproxy.ports": count}
        )
        if network in self.engine.networks:
            self.engine.join(box, network)

    @rule(data=st.data(), state=st.sampled_from([*sorted(ALIVE), "exited", "dead", "removing"]))
    def change(self, data: st.DataObject, state: str) -> None:
        box = self.draw(data, self.strangers())
        if box and not (state in SERVING and self.engine.conflicts(box)):
            box.state = state

    @rule(data=st.data())
    def remove(self, data: st.DataObject) -> None:
        box = self.draw(data, self.strangers())
        if box:
            self.engine.boxes.remove(box)

    @rule(data=st.data(), network=NETWORKS)
    def attach(self, data: st.DataObject, network: str) -> None:
        box = self.draw(data, self.strangers())
        if box and network in self.engine.networks and network not in box.networks:
            self.engine.join(box, network)

    @rule(data=st.data(), network=NETWORKS)
    def detach(self, data: st.DataObject, network: str) -> None:
        box = self.draw(data, self.strangers())
        if box:
            box.networks.pop(network, None)

    @rule(data=st.data(), number=st.integers(0, 3))
    def rename(self, data: st.DataObject, number: int) -> None:
        box = self.draw(data, self.strangers())
        if box and not any(one.name == f"other{number}" for one in self.engine.boxes):
            box.name = f"other{number}"

    @rule(
        name=st.sampled_from(["robot", "rosproxy", "web", proxy_name(ROBOT), sandbox_name(ROBOT)]),
        port=PORTS,
        state=st.sampled_from(["running", "created"]),
        network=NETWORKS,
    )
    def stranger(self, name: str, port: int, state: str, network: str) -> None:
        """A container that publishes a port, maybe under a name that a proxy would have."""
        if any(box.name == name for box in self.engine.boxes):
            return
        box = self.engine.add(name, ports=frozenset({port}))
        if network in self.engine.networks:
            self.engine.join(box, network)
        if not self.engine.conflicts(box):
            box.state = state

    # networks, ports, image

    @rule(name=NETWORKS)
    def make_network(self, name: str) -> None:
        if name not in self.engine.networks:
            self.engine.add_network(name, internal="inner" in name)

    @rule(name=NETWORKS | st.just(SETTINGS.uplink))
    def remove_network(self, name: str) -> None:
        if name in self.engine.networks and not self.engine.active(name):
            del self.engine.networks[name]

    @rule(port=PORTS, hidden=st.booleans(), named=st.booleans())
    def take_port(self, port: int, hidden: bool, named: bool) -> None:
        self.engine.names_ports = named
        if not any(port in box.ports for box in self.engine.boxes if box.state in SERVING):
            (self.engine.hidden if hidden else self.engine.open).add(port)

    @rule(port=PORTS)
    def let_port_go(self, port: int) -> None:
        self.engine.hidden.discard(port)
        self.engine.open.discard(port)

    @rule(image=st.sampled_from(["image-1", "image-2", ""]))
    def change_image(self, image: str) -> None:
        self.engine.image = image

    # what people do to proxies

    @rule(data=st.data(), state=st.sampled_from(["exited", "paused", "restarting", "removing"]))
    def meddle(self, data: st.DataObject, state: str) -> None:
        """A sandbox that ends leaves its proxy running in a namespace that nobody reaches."""
        box = self.draw(data, self.boxes("running"))
        if box:
            box.state = state

    @rule(data=st.data(), state=st.sampled_from(["dead", "removing"]))
    def break_one(self, data: st.DataObject, state: str) -> None:
        box = self.draw(data, self.boxes("exited"))
        if box:
            box.state = state

    @rule(data=st.data())
    def start_by_hand(self, data: st.DataObject) -> None:
        box = self.draw(data, self.boxes("exited", "restarting"))
        serving = self.boxes(*SERVING, role=box.role) if box else []
        if box and box.own and box.own.key not in {one.own.key for one in serving if one.own}:
            self.start(box)

    @rule(proxies_start=st.booleans(), first=st.sampled_from([ROLE_PROXY, ROLE_SANDBOX]))
    def engine_restarts(self, proxies_start: bool, first: str) -> None:
        """Everything stops; what the engine starts again, it starts in no good order."""
        boxes = sorted(self.boxes("running"), key=lambda box: box.role != first)
        for box in boxes:
            box.state = "exited"
        for box in boxes:
            if proxies_start or box.role == ROLE_SANDBOX:
                self.start(box)

    def start(self, box: Box) -> None:
        box.state = "exited"
        with contextlib.suppress(Failed):
            self.engine.start(box)

    @rule(data=st.data())
    def remove_own(self, data: st.DataObject) -> None:
        box = self.draw(data, self.boxes())
        if box:
            self.engine.boxes.remove(box)

    @rule(data=st.data(), network=NETWORKS)
    def detach_own(self, data: st.DataObject, network: str) -> None:
        box = self.draw(data, self.boxes(role=ROLE_SANDBOX))
        if box:
            box.networks.pop(network, None)

    # the controller

    @rule(seconds=st.sampled_from([0.5, 5.0, 30.0]))
    def wait(self, seconds: float) -> None:
        self.controller.now += seconds

    @rule(data=st.data(), killed=st.booleans())
    def look(self, data: st.DataObject, killed: bool) -> None:
        """One look; the controller may be killed after any of its actions."""
        found = self.controller.look()
        most = data.draw(st.integers(0, len(found.actions))) if killed else None
        self.carry_out(found, most)
        if killed:
            self.lose_memory()

    @rule()
    def come_to_rest(self) -> None:
        for _ in range(200):
            found = self.controller.look()
            failed = self.carry_out(found)
            assert all(isinstance(error, Refused) for _, error in failed), failed
            for box in self.boxes("removing"):
                self.engine.boxes.remove(box)
            if not found.actions and found.again_in is None:
                break
            self.controller.now += found.again_in or 0.0
        else:
            raise AssertionError(f"never comes to rest: {found.actions}")
        self.check_all_is_as_wished(found)

    def carry_out(self, found: Plan, most: int | None = None) -> list[tuple[Action, Failed]]:
        self.check_new_ranges(found)
        before = self.engine.observe()
        remembered = self.controller.memory.served
        self.may_move |= {
            key
            for key, ports in self.served.items()
            if self.published(ports) or key not in remembered
        }
        failed = self.controller.carry_out(found, most)
        refused = {action.name for action, _ in failed if isinstance(action, Start)}
        self.may_move |= {own.key for box, own in self.own() if box.name in refused}
        wanted = {one.key for one in found.desired if one.live}
        for key in before.keys - {own.key for _, own in self.own()} - wanted:
            self.served.pop(key, None)
        return failed

    def published(self, ports: PortRange) -> bool:
        """Whether a stranger that runs has some of these ports."""
        running = [box for box in self.engine.boxes if not box.own and box.state in STARTED]
        return any(port in ports for box in running for port in box.ports)

    def lose_memory(self) -> None:
        """Ports are then only known as long as there is a container that has had them."""
        self.controller.memory = Memory()
        kept = {own.key for box, own in self.own(role=ROLE_SANDBOX) if box.state != "created"}
        self.served = {key: ports for key, ports in self.served.items() if key in kept}

    # what must hold

    def check_new_ranges(self, found: Plan) -> None:
        """Ports of new sandboxes are nobody else's; who has ports keeps them."""
        seen = self.engine.observe()
        strangers = {port for one in seen.containers for port in one.host_ports}
        for action in found.actions:
            if not isinstance(action, CreateSandbox):
                continue
            key, ports = action.sandbox.key, action.sandbox.range
            had = [own.range for _, own in self.own() if own.key == key]
            had += [self.served[key]] if key in self.served else []
            new = {port for port in ports.ports() if not any(port in one for one in had)}
            assert not new & (strangers | seen.host.listening)
            assert not any(port in EPHEMERAL or port in reserved_ports(key) for port in new)
            for one in seen.sandboxes:
                assert one.key == key or not overlap(one.range, ports)

    @invariant()
    def one_of_each_runs_for_each_key(self) -> None:
        running = [(own.key, own.role) for _, own in self.own(*SERVING)]
        assert len(running) == len(set(running))

    @invariant()
    def who_serves_keeps_its_ports(self) -> None:
        for _, own in self.own(*SERVING, role=ROLE_SANDBOX):
            served = self.served.get(own.key)
            if served is not None and own.key not in self.may_move:
                assert own.range.first == served.first
                assert len(own.range) >= len(served)
            self.served[own.key] = own.range
            self.may_move.discard(own.key)

    @invariant()
    def no_two_sandboxes_share_ports(self) -> None:
        held = [(own.key, own.range) for _, own in self.own(role=ROLE_SANDBOX)]
        for key, ports in held:
            assert not any(overlap(ports, other) for one, other in held if one != key)

    def check_all_is_as_wished(self, found: Plan) -> None:
        wishes, _ = read_wishes(self.engine.observe(), SETTINGS)
        fine = {
            name
            for name, network in self.engine.networks.items()
            if network.internal or name >= SETTINGS.uplink
        }
        live = [wish for wish in wishes if wish.alive and wish.networks & fine]
        assert {own.key for _, own in self.own()} <= {wish.key for wish in live}
        told = {problem.subject for problem in found.problems if problem.fatal}
        for key in {wish.key for wish in live}:
            wanted = {n for wish in live if wish.key == key for n in wish.networks & fine}
            if not told & {f"proxy image {SETTINGS.image}", f"proxy {proxy_name(key)}"}:
                self.check_key(key, wanted)
                for wish in live:
                    if wish.key == key and self.boxes("running", role=ROLE_SANDBOX):
                        self.check_names(wish, wish.networks & fine, found)

    def check_names(self, wish: Wish, networks: frozenset[str], found: Plan) -> None:
        """Who is not told otherwise finds its own proxy, and nobody else, by the name it uses."""
        if not wish.needs or f"container {wish.container}" in {p.subject for p in found.problems}:
            return
        for network in networks:
            answering = [
                box
                for box in self.engine.boxes
                if network in box.networks
                and wish.needs in box.networks[network][1]
                and box.state not in ("dead", "removing")
            ]
            assert [box.own.key if box.own else box.name for box in answering] == [wish.key]

    def check_key(self, key: Key, wanted: set[str]) -> None:
        own = [(box, own) for box, own in self.own() if own.key == key]
        sandboxes = [(box, own) for box, own in own if box.role == ROLE_SANDBOX]
        proxies = [(box, own) for box, own in own if box.role == ROLE_PROXY]
        assert len(sandboxes) == 1
        sandbox, is_ = sandboxes[0]
        if sandbox.state == "restarting":
            return
        assert sandbox.state == "running"
        assert set(sandbox.networks) == {SETTINGS.uplink, *wanted}
        assert self.is_named(sandbox, sandbox_name(key))
        assert len(proxies) == 1
        proxy, runs = proxies[0]
        assert proxy.state in ("running", "restarting")
        assert self.engine.home(proxy) is sandbox
        assert proxy.namespace == sandbox.namespace or proxy.state == "restarting"
        assert self.is_named(proxy, proxy_name(key))
        assert runs.range == is_.range
        if self.engine.image:
            assert is_.fingerprint == sandbox_fingerprint(key, is_.range, SETTINGS)
            assert runs.fingerprint == fingerprint(key, is_.range, SETTINGS, self.engine.image)

    def is_named(self, box: Box, name: str) -> bool:
        """Whether it has its name, if no stranger has."""
        return (box.name == name) != any(one.name == name for one in self.strangers())

    def strangers(self) -> list[Box]:
        return [box for box in self.engine.boxes if not box.own]


TestHosts: Any = Hosts.TestCase
TestHosts.settings = settings(stateful_step_count=40)
