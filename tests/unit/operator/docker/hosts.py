"""A host on which everything happens that happens on hosts, and what must always hold there.

Each event is a method of two numbers, which choose what it happens to.
"""

import contextlib
from collections.abc import Sequence
from typing import TypeVar

from rosproxy.leases.ports import PortRange
from rosproxy.settings import DataPlane, Direction
from rosproxy_operator.common.allocation import overlap
from rosproxy_operator.docker.planner.actions import Action, Create, CreateSandbox, Start
from rosproxy_operator.docker.planner.desired import chosen_direction, chosen_plane
from rosproxy_operator.docker.planner.model import STARTED, Key, Member, PlanSettings
from rosproxy_operator.docker.planner.plan import DockerPlan
from rosproxy_operator.docker.planner.specs import (
    ROLE_PROXY,
    ROLE_SANDBOX,
    OwnLabels,
    own_labels,
    proxy_fingerprint,
    proxy_name,
    reserved_ports,
    sandbox_fingerprint,
    sandbox_name,
)
from rosproxy_operator.docker.planner.state import DockerMemory
from tests.unit.operator.docker.builders import read_members
from tests.unit.operator.docker.simulation import SERVING, Box, Controller, Engine, Failed, Refused

HERE = "192.0.2.10"
ROBOT = Key("http://robot:11311", HERE)
SETTINGS = PlanSettings(
    advertise_host=HERE,
    ports=2,
    port_window=PortRange(11400, 11415),
    grace=10.0,
    max_ports=3,
    allow_data_plane=("auto", "kernel", "splice"),
)
EPHEMERAL = PortRange(11414, 11500)
MASTERS = ("http://robot:11311", "http://arm:11312", "http://192.0.2.9:11402")
NETWORKS = ("app", "lab", "inner", "0-early", "0-inner")
COUNTS = ("2", "1", "3", "5", "nonsense")
PLANES = ("", "kernel", "splice", "auto", "copy", "nonsense")
ENVS = ("", "http://rosproxy:11311", "http://robot:11311", "http://arm:11312")
STATES = ("running", "exited", "created", "paused", "restarting", "dead", "removing")
STRANGERS = ("robot", "rosproxy", "web", proxy_name(ROBOT), sandbox_name(ROBOT))
T = TypeVar("T")


def pick(items: Sequence[T], number: int) -> T:
    return items[number % len(items)]


class Hosts:
    """A host with labelled containers, the operator, and people who meddle."""

    def __init__(self) -> None:
        self.engine = Engine(SETTINGS, EPHEMERAL)
        self.controller = Controller(self.engine, SETTINGS)
        for name in NETWORKS[:3]:
            self.engine.add_network(name, internal="inner" in name)
        self.served: dict[Key, PortRange] = {}
        self.may_move: set[Key] = set()

    def own(self, *states: str, role: str = "") -> list[tuple[Box, OwnLabels]]:
        """The operator's containers."""
        return [
            (box, box.own)
            for box in self.engine.boxes
            if box.own and (not states or box.state in states) and role in ("", box.role)
        ]

    def boxes(self, *states: str, role: str = "") -> list[Box]:
        return [box for box, _ in self.own(*states, role=role)]

    def strangers(self) -> list[Box]:
        return [box for box in self.engine.boxes if not box.own]

    # containers of users

    def run(self, n: int, m: int) -> None:
        """A labelled container comes, usually on a network that is there."""
        labels = {
            "rosproxy.enable": "true",
            "rosproxy.master-uri": pick(MASTERS, n),
            "rosproxy.ports": pick(COUNTS, n // 3),
        }
        if plane := pick(PLANES, (n + m) // 7):
            labels["rosproxy.data-plane"] = plane
        if len(self.strangers()) > 6:
            return
        box = self.engine.add(
            f"node{next(self.engine.ids)}",
            state=pick(STATES[:3], m // 20),
            env=pick(ENVS, m // 5),
            labels=labels,
        )
        if networks := sorted(self.engine.networks.keys() - {SETTINGS.uplink}):
            self.engine.join(box, pick(networks, m))

    def change(self, n: int, m: int) -> None:
        """A container pauses, exits, starts, …"""
        state = pick(STATES, m)
        if boxes := self.strangers():
            box = pick(boxes, n)
            if state not in SERVING or not self.engine.conflicts(box):
                box.state = state

    def remove(self, n: int, _: int) -> None:
        if boxes := self.strangers():
            self.engine.boxes.remove(pick(boxes, n))

    def attach(self, n: int, m: int) -> None:
        if boxes := self.strangers():
            box, network = pick(boxes, n), pick(NETWORKS, m)
            if network in self.engine.networks and network not in box.networks:
                self.engine.join(box, network)

    def detach(self, n: int, m: int) -> None:
        if boxes := self.strangers():
            pick(boxes, n).networks.pop(pick(NETWORKS, m), None)

    def rename(self, n: int, m: int) -> None:
        name = pick(STRANGERS, m)
        if (boxes := self.strangers()) and not self.engine.named(name):
            pick(boxes, n).name = name

    def stranger(self, n: int, m: int) -> None:
        """A container that publishes a port, maybe under a name that a proxy would have."""
        name = pick(STRANGERS, n)
        if self.engine.named(name):
            return
        box = self.engine.add(name, ports=frozenset({11400 + m % 16}))
        network = pick(NETWORKS, m)
        if network in self.engine.networks:
            self.engine.join(box, network)
        if not self.engine.conflicts(box) and n % 2:
            box.state = "running"

    def forge(self, n: int, m: int) -> None:
        """A container of an image that has the labels of what the operator makes."""
        own = [box.labels for box in self.boxes()]
        made = CreateSandbox("", ROBOT, PortRange(11400, 11401))
        name = f"forged{next(self.engine.ids)}"
        if len(self.strangers()) > 6:
            return
        labels = pick([own_labels(made), *own], n)
        box = self.engine.add(name, labels=labels, state=pick(STATES[:3], m // 5))
        if networks := sorted(self.engine.networks.keys()):
            self.engine.join(box, pick(networks, m))

    # networks, ports, image

    def make_network(self, n: int, _: int) -> None:
        name = pick(NETWORKS, n)
        if name not in self.engine.networks:
            self.engine.add_network(name, internal="inner" in name)

    def remove_network(self, n: int, _: int) -> None:
        name = pick((*NETWORKS, SETTINGS.uplink), n)
        if name in self.engine.networks and not self.engine.active(name):
            del self.engine.networks[name]

    def take_port(self, n: int, m: int) -> None:
        """Another program listens; the operator may be unable to see it."""
        self.engine.names_ports = bool(m & 1)
        port = 11400 + n % 16
        if not any(port in box.ports for box in self.engine.boxes if box.state in SERVING):
            (self.engine.hidden if m & 2 else self.engine.open).add(port)

    def take_own_port(self, n: int, m: int) -> None:
        """A proxy is down for a moment, and another program takes its port."""
        if boxes := self.boxes(role=ROLE_SANDBOX):
            box = pick(boxes, n)
            box.state = "exited" if box.state in SERVING else box.state
            self.take_port(min(box.ports) - 11400 + n % len(box.ports), m)

    def let_ports_go(self, _n: int, _m: int) -> None:
        self.engine.hidden.clear()
        self.engine.open.clear()

    def change_image(self, n: int, _: int) -> None:
        self.engine.image = pick(("image-1", "image-2", ""), n)

    # what people and engines do to proxies

    def meddle(self, n: int, m: int) -> None:
        """A sandbox that ends leaves its proxy running in a namespace that nobody reaches."""
        if boxes := self.boxes("running"):
            pick(boxes, n).state = pick(("exited", "paused", "restarting", "removing"), m)

    def break_one(self, n: int, m: int) -> None:
        if boxes := self.boxes("exited"):
            pick(boxes, n).state = pick(("dead", "removing"), m)

    def start_by_hand(self, n: int, _: int) -> None:
        if boxes := self.boxes("exited", "restarting"):
            box = pick(boxes, n)
            serving = self.own(*SERVING, role=box.role)
            if box.own and box.own.key not in {own.key for one, own in serving if one is not box}:
                self.start(box)

    def engine_restarts(self, n: int, m: int) -> None:
        """Everything stops; what the engine starts again, it starts in no good order."""
        first = pick((ROLE_PROXY, ROLE_SANDBOX), n)
        boxes = sorted(self.boxes("running"), key=lambda box: box.role != first)
        for box in boxes:
            box.state = "exited"
        for box in boxes:
            if m & 1 or box.role == ROLE_SANDBOX:
                self.start(box)

    def start(self, box: Box) -> None:
        box.state = "exited"
        with contextlib.suppress(Failed):
            self.engine.start(box)

    def remove_own(self, n: int, _: int) -> None:
        if boxes := self.boxes():
            self.engine.boxes.remove(pick(boxes, n))

    def rename_own(self, n: int, m: int) -> None:
        """Under any other name it would be a stranger, for all that the operator knows."""
        if boxes := self.boxes():
            box = pick(boxes, n)
            own = sandbox_name if box.role == ROLE_SANDBOX else proxy_name
            name = own(box.own.key) + pick(("-old", "-2", "-old-2"), m) if box.own else ""
            if name and not self.engine.named(name):
                box.name = name

    def detach_own(self, n: int, m: int) -> None:
        if boxes := self.boxes(role=ROLE_SANDBOX):
            pick(boxes, n).networks.pop(pick((*NETWORKS[:3], SETTINGS.uplink), m), None)

    # the operator

    def wait(self, n: int, _: int) -> None:
        self.controller.now += pick((0.5, 5.0, 30.0), n)

    def look(self, _n: int, _m: int) -> None:
        self.carry_out(self.controller.look())

    def look_and_be_killed(self, n: int, _: int) -> None:
        """The operator is killed after any of its actions and knows nothing any more."""
        found = self.controller.look()
        self.carry_out(found, n % (len(found.actions) + 1))
        self.lose_memory()

    def look_and_stall(self, n: int, _: int) -> None:
        """Only some of the actions are carried out before the next look."""
        found = self.controller.look()
        self.carry_out(found, n % (len(found.actions) + 1))

    def come_to_rest(self, _n: int = 0, _m: int = 0) -> None:
        """Nothing else happens: everything must be as wished after some looks."""
        for _ in range(100):
            found = self.controller.look()
            failed = self.carry_out(found)
            assert all(isinstance(error, Refused) for _, error in failed), failed
            self.check()
            for box in self.boxes("removing"):
                self.engine.boxes.remove(box)
            if not found.actions and found.again_in is None:
                break
            self.controller.now += found.again_in or 0.0
        else:
            raise AssertionError(f"never comes to rest: {found.actions}")
        self.check_all_is_as_wished(found)

    def carry_out(self, found: DockerPlan, most: int | None = None) -> list[tuple[Action, Failed]]:
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
        running = [box for box in self.strangers() if box.state in STARTED]
        return any(port in ports for box in running for port in box.ports)

    def lose_memory(self) -> None:
        """Ports are then only known as long as there is a container that has had them."""
        self.controller.memory = DockerMemory()
        kept = {own.key for box, own in self.own(role=ROLE_SANDBOX) if box.state != "created"}
        self.served = {key: ports for key, ports in self.served.items() if key in kept}

    # what must hold

    def check(self) -> None:
        """What holds at any moment."""
        running = [(own.key, own.role) for _, own in self.own(*SERVING)]
        assert len(running) == len(set(running)), "one of each runs for each key"
        for _, own in self.own(*SERVING, role=ROLE_SANDBOX):
            served = self.served.get(own.key)
            if served is not None and own.key not in self.may_move:
                assert own.range.first == served.first, "who serves keeps its ports"
                assert len(own.range) >= len(served)
            self.served[own.key] = own.range
            self.may_move.discard(own.key)
        held = [(own.key, own.range) for _, own in self.own(role=ROLE_SANDBOX)]
        for key, ports in held:
            others = [other for one, other in held if one != key]
            assert not any(overlap(ports, other) for other in others), "ports are one's own"

    def check_new_ranges(self, found: DockerPlan) -> None:
        """Ports of new sandboxes are nobody else's; who has ports keeps them."""
        seen = self.engine.observe()
        strangers = {port for one in seen.containers for port in one.host_ports}
        for action in found.actions:
            if not isinstance(action, CreateSandbox):
                continue
            key, ports = action.key, action.range
            had = [own.range for _, own in self.own() if own.key == key]
            had += [self.served[key]] if key in self.served else []
            new = {port for port in ports.ports() if not any(port in one for one in had)}
            assert not new & (strangers | seen.listening)
            assert not any(port in EPHEMERAL or port in reserved_ports(key) for port in new)
            for one in seen.sandboxes:
                assert one.key == key or not overlap(one.range, ports)

    def check_all_is_as_wished(self, found: DockerPlan) -> None:
        members, _ = read_members(self.engine.observe(), SETTINGS)
        fine = frozenset(
            name
            for name, network in self.engine.networks.items()
            if network.internal or name >= SETTINGS.uplink
        )
        live = [member for member in members if member.container.alive and member.networks & fine]
        assert {own.key for _, own in self.own()} <= {member.key for member in live}
        fatal = {problem.subject for problem in found.problems if problem.fatal}
        told = {problem.subject for problem in found.problems}
        for key in sorted({member.key for member in live}):
            if not fatal & {f"proxy image {SETTINGS.proxy_image}", f"proxy {proxy_name(key)}"}:
                mine = [member for member in live if member.key == key]
                plane = chosen_plane(mine, SETTINGS.data_plane)
                direction = chosen_direction(mine, SETTINGS.direction)
                wanted = {n for member in mine for n in member.networks & fine}
                self.check_key(key, wanted, plane, direction)
                for member in mine:
                    if f"container {member.container.name}" not in told:
                        self.check_names(member, member.networks & fine)

    def check_key(self, key: Key, wanted: set[str], plane: DataPlane, direction: Direction) -> None:
        own = [(box, own) for box, own in self.own() if own.key == key]
        if any(box.state == "restarting" and box.role == ROLE_SANDBOX for box, _ in own):
            return
        assert sorted(box.role for box, _ in own) == [ROLE_SANDBOX, ROLE_PROXY]
        (sandbox, is_), (proxy, runs) = sorted(own, key=lambda one: one[0].role == ROLE_PROXY)
        assert sandbox.state == "running"
        assert proxy.state in ("running", "restarting")
        assert set(sandbox.networks) == {SETTINGS.uplink, *wanted}
        assert self.is_named(sandbox, sandbox_name(key))
        assert self.is_named(proxy, proxy_name(key))
        assert self.engine.home(proxy) is sandbox
        assert proxy.namespace == sandbox.namespace or proxy.state == "restarting"
        assert runs.range == is_.range
        if self.engine.image:
            box = CreateSandbox("", key, is_.range, forwards=plane == "kernel")
            assert is_.fingerprint == sandbox_fingerprint(box, SETTINGS)
            self.check_process(runs, Create("", key, is_.range, "", plane, direction=direction))

    def check_process(self, runs: OwnLabels, proxy: Create) -> None:
        assert runs.fingerprint == proxy_fingerprint(proxy, SETTINGS, self.engine.image, "")

    def is_named(self, box: Box, name: str) -> bool:
        """Whether it has its name, if no stranger has."""
        return (box.name == name) != any(one.name == name for one in self.strangers())

    def check_names(self, member: Member, networks: frozenset[str]) -> None:
        """By the name that a container uses it finds its own proxy and nobody else."""
        for network in networks if member.needs else ():
            found = [
                box.own.key if box.own else box.name
                for box in self.engine.boxes
                if network in box.networks
                and member.needs in box.networks[network][1] | {box.name}
                and box.state not in ("dead", "removing")
            ]
            restarting = [own.key for _, own in self.own("restarting", role=ROLE_SANDBOX)]
            assert found == [member.key] or member.key in restarting
