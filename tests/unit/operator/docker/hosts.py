"""A host with random events. Each event is a method of two numbers, which choose the object."""

import contextlib
from collections.abc import Sequence
from typing import TypeVar

from rosproxy.shared.ports import PortRange
from rosproxy_operator.docker.planner.actions import Action, CreateSandbox, Start
from rosproxy_operator.docker.planner.model import STARTED
from rosproxy_operator.docker.planner.plan import DockerPlan
from rosproxy_operator.docker.planner.specs import (
    ROLE_FLUSH,
    ROLE_LAN_RELAY,
    ROLE_PROXY,
    ROLE_REDIRECT,
    ROLE_SANDBOX,
    flush_name,
    lan_relay_name,
    own_labels,
    proxy_name,
    read_own,
    sandbox_name,
)
from rosproxy_operator.docker.planner.state import DockerMemory
from tests.unit.operator.docker.invariants import ROBOT, SETTINGS, Invariants
from tests.unit.operator.docker.simulation import SERVING, Box, Failed, Refused

MASTERS = ("http://robot:11311", "http://arm:11312", "http://192.0.2.9:11402")
REDIRECTS = ("", "true", "", "false", "")
NETWORKS = ("app", "lab", "inner", "0-early", "0-inner")
COUNTS = ("2", "1", "3", "5", "nonsense")
PLANES = ("", "kernel", "splice", "auto", "copy", "nonsense")
VERSIONS = ("1", "2", "1,2", "1", "nonsense")
DOMAINS = ("0", "16")
PEERS = ("robot", "arm:11400", "")
ADDRESSED = "http://192.0.2.9:11402"
ZENOH_ROUTER = "192.0.2.7"
ENVS = ("", "http://rosproxy:11311", "http://robot:11311", "http://arm:11312", ADDRESSED)
STATES = ("running", "exited", "created", "paused", "restarting", "dead", "removing")
STRANGERS = ("robot", "rosproxy", "web", proxy_name(ROBOT), sandbox_name(ROBOT))
T = TypeVar("T")


def pick(items: Sequence[T], number: int) -> T:
    return items[number % len(items)]


class Hosts(Invariants):
    """A host with labelled containers, the operator, and users that interfere."""

    # containers of users

    def run(self, n: int, m: int) -> None:
        """A labelled container comes, usually on an existing network."""
        labels = {
            "rosproxy.enable": "true",
            "rosproxy.master-uri": pick(MASTERS, n),
            "rosproxy.ports": pick(COUNTS, n // 3),
            "rosproxy.ros": pick(VERSIONS, (2 * n + m) // 5),
            "rosproxy.domain": pick(DOMAINS, n // 2),
            "rosproxy.peers": pick(PEERS, m // 3),
        }
        if plane := pick(PLANES, (n + m) // 7):
            labels["rosproxy.data-plane"] = plane
        if redirect := pick(REDIRECTS, n // 4):
            labels["rosproxy.redirect"] = redirect
        if (n + m) % 4 == 0:
            labels |= {"rosproxy.udp": "true", "rosproxy.direction": "both"}
        if len(self.strangers()) > 6:
            return
        box = self.engine.add(
            f"node{next(self.engine.ids)}",
            env=pick(ENVS, m // 5),
            labels=labels,
        )
        self.engine.begin(box, pick(STATES[:3], m // 20))
        if networks := sorted(self.engine.networks.keys() - {SETTINGS.uplink}):
            self.engine.join(box, pick(networks, m))

    def run_zenoh(self, n: int, m: int) -> None:
        """A container of rmw_zenoh comes, sometimes with a router, or in the network of another."""
        homes = [box for box in self.strangers() if not box.mode]
        if len(self.strangers()) > 6:
            return
        variables = {"ROS_DISTRO": "kilted", "RMW_IMPLEMENTATION": "rmw_zenoh_cpp"}
        if n % 3 == 0:
            variables["ZENOH_CONFIG_OVERRIDE"] = f'connect/endpoints=["tcp/{ZENOH_ROUTER}:7447"]'
        peers = pick(("", "robot", "arm:7448"), m)
        box = self.engine.add(
            f"zenoh{next(self.engine.ids)}",
            labels={
                "rosproxy.enable": "true",
                "rosproxy.peers": peers,
                "rosproxy.zenoh-link": pick(("", "tls/cloud", "tls/evil"), n // 2 + m),
            },
            variables=variables,
            is_router=n % 5 == 4,
            mode=f"container:{pick(homes, m).id}" if homes and n % 4 == 3 else "",
        )
        self.engine.begin(box, pick(STATES[:3], m // 20))
        networks = sorted(self.engine.networks.keys() - {SETTINGS.uplink})
        if networks and not box.mode:
            self.engine.join(box, pick(networks, m))

    def change(self, n: int, m: int) -> None:
        """A container pauses, exits, starts, …"""
        state = pick(STATES, m)
        if boxes := self.strangers():
            box = pick(boxes, n)
            if state not in SERVING or not self.engine.conflicts(box):
                self.engine.begin(box, state)

    def share(self, n: int, m: int) -> None:
        """A container with an address in ROS_MASTER_URI joins the network of another container."""
        homes = [box for box in self.strangers() if not box.mode]
        if not homes or len(self.strangers()) > 6:
            return
        box = self.engine.add(
            f"guest{next(self.engine.ids)}",
            env=ADDRESSED,
            labels={"rosproxy.enable": "true"},
            mode=f"container:{pick(homes, n).id}",
        )
        self.engine.begin(box, pick(STATES[:3], m // 20))

    def remove(self, n: int, _: int) -> None:
        if boxes := self.strangers():
            self.engine.boxes.remove(pick(boxes, n))

    def attach(self, n: int, m: int) -> None:
        if boxes := self.strangers():
            box = pick(boxes, n)
            network = pick(NETWORKS, m)
            if network in self.engine.networks and network not in box.networks:
                self.engine.join(box, network)

    def detach(self, n: int, m: int) -> None:
        if boxes := self.strangers():
            pick(boxes, n).networks.pop(pick(NETWORKS, m), None)

    def rename(self, n: int, m: int) -> None:
        """Not a container with forged labels: the simulation has no HostConfig to detect the
        forgery.
        """
        name = pick(STRANGERS, m)
        boxes = [box for box in self.strangers() if read_own(box.labels) is None]
        if boxes and not self.engine.named(name):
            pick(boxes, n).name = name

    def stranger(self, n: int, m: int) -> None:
        """A container that publishes a port, maybe under a name that a proxy would have."""
        name = pick(STRANGERS, n)
        if self.engine.named(name):
            return
        ports = frozenset({11400 + m % 16})
        udp = bool(m & 1)
        box = self.engine.add(name, **{"udp" if udp else "ports": ports})
        if not self.engine.conflicts(box) and n % 2:
            self.engine.begin(box, "running")
        network = pick(NETWORKS, m)
        if network in self.engine.networks:
            self.engine.join(box, network)

    def forge(self, n: int, m: int) -> None:
        """A container of an image that has the labels of what the operator makes."""
        own = [box.labels for box in self.boxes()]
        made = CreateSandbox("", ROBOT, PortRange(11400, 11401))
        name = f"forged{next(self.engine.ids)}"
        if len(self.strangers()) > 6:
            return
        labels = pick([own_labels(made), *own], n)
        box = self.engine.add(name, labels=labels)
        self.engine.begin(box, pick(STATES[:3], m // 5))
        if networks := sorted(self.engine.networks.keys()):
            self.engine.join(box, pick(networks, m))

    def fail_redirects(self, n: int, _: int) -> None:
        """Redirects fail for a while, as without support in the kernel."""
        self.engine.redirects_fail = bool(n & 1)

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
        """Another program takes a port, perhaps invisible to the operator."""
        self.engine.names_ports = bool(m & 1)
        port = 11400 + n % 16
        taken = (box.ports | box.udp for box in self.engine.boxes if box.state in SERVING)
        if not any(port in ports for ports in taken):
            (self.engine.hidden if m & 2 else self.engine.open).add(port)

    def take_own_port(self, n: int, m: int) -> None:
        """A proxy is down for a moment, and another program takes its port."""
        if boxes := self.boxes(role=ROLE_SANDBOX):
            box = pick(boxes, n)
            box.state = "exited" if box.state in SERVING else box.state
            if ports := sorted(box.ports | box.udp):
                self.take_port(ports[n % len(ports)] - 11400, m)

    def let_ports_go(self, _n: int, _m: int) -> None:
        self.engine.hidden.clear()
        self.engine.open.clear()

    def change_image(self, n: int, _: int) -> None:
        self.engine.image = pick(("image-1", "image-2", ""), n)

    # what people and engines do to proxies

    def meddle(self, n: int, m: int) -> None:
        """A sandbox that ends leaves the proxy running in an unreachable namespace."""
        if boxes := self.boxes("running"):
            pick(boxes, n).state = pick(("exited", "paused", "restarting", "removing"), m)

    def break_one(self, n: int, m: int) -> None:
        if boxes := self.boxes("exited"):
            self.forget(pick(boxes, n)).state = pick(("dead", "removing"), m)

    def start_by_hand(self, n: int, _: int) -> None:
        if boxes := self.boxes("exited", "restarting"):
            box = pick(boxes, n)
            serving = self.own(*SERVING, role=box.role)
            if box.own and box.own.place not in {
                own.place for other, own in serving if other is not box
            }:
                self.start(box)

    def engine_restarts(self, n: int, m: int) -> None:
        """Everything stops. The engine starts containers again, in an unfavourable order."""
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
            self.engine.boxes.remove(self.forget(pick(boxes, n)))

    def forget(self, box: Box) -> Box:
        """Without its record, the operator does not know of a rule that is no longer wanted."""
        if box.redirect is not None:
            self.forgotten.add((box.namespace, box.redirect.place))
        return box

    def rename_own(self, n: int, m: int) -> None:
        """Only to names that the operator recognizes as its own."""
        if boxes := [box for box in self.boxes() if box.role != ROLE_REDIRECT]:
            box = pick(boxes, n)
            names = {
                ROLE_SANDBOX: sandbox_name,
                ROLE_LAN_RELAY: lan_relay_name,
                ROLE_FLUSH: flush_name,
            }
            own = names.get(box.role, proxy_name)
            name = own(box.own.place) + pick(("-old", "-2", "-old-2"), m) if box.own else ""
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
        """The operator is killed after any action, and loses its memory."""
        plan = self.controller.look()
        self.carry_out(plan, n % (len(plan.actions) + 1))
        self.lose_memory()

    def look_and_stall(self, n: int, _: int) -> None:
        """Only some of the actions are carried out before the next look."""
        plan = self.controller.look()
        self.carry_out(plan, n % (len(plan.actions) + 1))

    def come_to_rest(self, _n: int = 0, _m: int = 0) -> None:
        """Nothing else happens: everything must be as wished after some looks."""
        self.engine.redirects_fail = False
        for _ in range(100):
            plan = self.controller.look()
            failed = self.carry_out(plan)
            assert all(isinstance(error, Refused) for _, error in failed), failed
            self.check()
            removed = self.boxes("removing")
            for box in removed:
                self.engine.boxes.remove(box)
            # A container that has gone makes the operator look again.
            if not plan.actions and plan.again_in is None and not removed:
                break
            self.controller.now += plan.again_in or 0.0
        else:
            raise AssertionError(f"never comes to rest: {plan.actions}")
        self.check_all_is_as_wished(plan)

    def carry_out(self, plan: DockerPlan, most: int | None = None) -> list[tuple[Action, Failed]]:
        self.check_new_ranges(plan)
        before = self.engine.observe()
        remembered = self.controller.memory.served
        self.may_move |= {
            place
            for place, ports in self.served.items()
            if self.published(ports) or place not in remembered
        }
        failed = self.controller.carry_out(plan, most)
        refused = {action.name for action, _ in failed if isinstance(action, Start)}
        self.may_move |= {own.place for box, own in self.own() if box.name in refused}
        wanted = {proxy.place for proxy in plan.desired if proxy.live}
        for place in before.places - {own.place for _, own in self.own()} - wanted:
            self.served.pop(place, None)
        return failed

    def published(self, ports: PortRange) -> bool:
        """Whether a stranger that runs has some of these ports."""
        running = [box for box in self.strangers() if box.state in STARTED]
        return any(port in ports for box in running for port in box.ports | box.udp)

    def lose_memory(self) -> None:
        """From now on the operator knows ports only from existing containers."""
        self.controller.memory = DockerMemory()
        started = {own.place for box, own in self.own(role=ROLE_SANDBOX) if box.state != "created"}
        self.served = {place: ports for place, ports in self.served.items() if place in started}
