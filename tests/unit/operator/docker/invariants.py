"""Invariants of a simulated host: at any moment, and after the operator has settled."""

from msgspec import structs

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortRange
from rosproxy_operator.common.port_ranges import overlap
from rosproxy_operator.docker.planner.actions import Create, CreateLanRelay, CreateSandbox
from rosproxy_operator.docker.planner.desired import proxy_spec
from rosproxy_operator.docker.planner.model import ALIVE, STARTED, Member
from rosproxy_operator.docker.planner.plan import DockerPlan
from rosproxy_operator.docker.planner.specs import (
    ROLE_FLUSH,
    ROLE_LAN_RELAY,
    ROLE_PROXY,
    ROLE_REDIRECT,
    ROLE_SANDBOX,
    OwnLabels,
    lan_relay_fingerprint,
    lan_relay_name,
    proxy_fingerprint,
    proxy_name,
    reserved_ports,
    sandbox_fingerprint,
    sandbox_name,
)
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.place import ZENOH, Master, Place
from tests.unit.operator.docker.builders import read_members
from tests.unit.operator.docker.simulation import GATEWAY, SERVING, Box, Controller, Engine

HERE = "192.0.2.10"
ROBOT = Place(Master("http://robot:11311"), HERE)
SETTINGS = PlanSettings(
    advertise_host=HERE,
    ports=2,
    port_window=PortRange(11400, 11415),
    grace=10.0,
    max_ports=3,
    allow_data_plane=("auto", "kernel", "splice"),
    allow_link=("tls/cloud:*",),
    zenoh_link_certificates="/etc/rosproxy/link",
)
EPHEMERAL = PortRange(11414, 11500)
INNER = "inner"
"""Part of the names of internal networks."""


class Invariants:
    """A simulated host with the operator."""

    def __init__(self) -> None:
        self.engine = Engine(SETTINGS, EPHEMERAL)
        self.controller = Controller(self.engine, SETTINGS)
        for name in ("app", "lab", INNER):
            self.engine.add_network(name, internal=INNER in name)
        self.served: dict[Place, PortRange] = {}
        self.may_move: set[Place] = set()
        self.forgotten: set[tuple[int, Place]] = set()

    def own(self, *states: str, role: str = "") -> list[tuple[Box, OwnLabels]]:
        """The operator's containers."""
        return [
            (box, own)
            for box in self.engine.boxes
            if (not states or box.state in states) and (own := box.own) and role in ("", own.role)
        ]

    def boxes(self, *states: str, role: str = "") -> list[Box]:
        return [box for box, _ in self.own(*states, role=role)]

    def strangers(self) -> list[Box]:
        return [box for box in self.engine.boxes if not box.own]

    # Invariants

    def check(self) -> None:
        """Check the invariants of any moment."""
        running = [(own.place, own.role) for _, own in self.own(*SERVING)]
        assert len(running) == len(set(running)), "at most one of each role runs"
        for _, own in self.own(*SERVING, role=ROLE_SANDBOX):
            served = self.served.get(own.place)
            if served is not None and own.place not in self.may_move:
                assert own.range.first == served.first, "a serving sandbox keeps its ports"
                assert len(own.range) >= len(served)
            self.served[own.place] = own.range
            self.may_move.discard(own.place)
        # A sandbox that never started holds no ports: a former sandbox may get the range back.
        boxes = self.own(role=ROLE_SANDBOX)
        ranges = [(own.place, own.range) for box, own in boxes if box.state != "created"]
        for place, ports in ranges:
            other_ranges = [other for owner, other in ranges if owner != place]
            assert not any(overlap(ports, other) for other in other_ranges), (
                "no two places share ports"
            )

    def check_new_ranges(self, plan: DockerPlan) -> None:
        """New sandboxes get free ports. A place with ports keeps these."""
        seen = self.engine.observe()
        for action in plan.actions:
            if not isinstance(action, CreateSandbox) or action.place == ZENOH:
                continue  # the ports of routers are not the host's
            place = action.place
            is_ros2 = place.graph.ros == "2"
            ports = action.range
            had = [own.range for _, own in self.own() if own.place == place]
            had += [self.served[place]] if place in self.served else []
            new = {port for port in ports.ports() if not any(port in old for old in had)}
            listening = seen.listening_udp if is_ros2 else seen.listening
            strangers = {
                port
                for container in seen.containers
                for port in (container.udp_ports if is_ros2 else container.host_ports)
            }
            assert not new & (strangers | listening)
            assert not any(port in EPHEMERAL or port in reserved_ports(place) for port in new)
            for sandbox in seen.sandboxes:
                foreign = sandbox.place != place and sandbox.container.state != "created"
                assert not (foreign and overlap(sandbox.range, ports))

    def check_all_is_as_wished(self, plan: DockerPlan) -> None:
        members, _ = read_members(self.engine.observe(), SETTINGS)
        fine = frozenset(
            name
            for name, network in self.engine.networks.items()
            if network.internal or name >= SETTINGS.uplink
        )
        live = [member for member in members if member.container.alive and member.networks & fine]
        # Without an image nothing can take a redirect away.
        stays = "" if self.engine.image else ROLE_REDIRECT
        places = {own.place for _, own in self.own() if own.role != stays}
        assert places <= {member.place for member in live}
        fatal = {problem.subject for problem in plan.problems if problem.fatal}
        told = {problem.subject for problem in plan.problems}
        for place in sorted({member.place for member in live}):
            if not fatal & {f"proxy image {SETTINGS.proxy_image}", f"proxy {proxy_name(place)}"}:
                mine = [member for member in live if member.place == place]
                wanted = {n for member in mine for n in member.networks & fine}
                self.check_place(place, wanted, self.made(place, mine))
                for member in mine:
                    if f"container {member.container.name}" not in told:
                        self.check_names(member, member.networks & fine)

        self.check_redirects(live)
        self.check_flushes()
        self.check_no_name_is_shared()

    def check_no_name_is_shared(self) -> None:
        """No proxy has an alias that is a name of another container on the same network."""
        strangers = [box for box in self.strangers() if box.state not in ("dead", "removing")]
        for sandbox, own in self.own("running", "paused", role=ROLE_SANDBOX):
            # The simulated engine keeps the name that a container had on joining.
            container_names = {sandbox.name, sandbox_name(own.place)}
            for network, (_, names) in sandbox.networks.items():
                others = {
                    name
                    for box in strangers
                    if network in box.networks
                    for name in box.networks[network][1] | {box.name}
                }
                assert not (names - container_names) & others, network

    def check_flushes(self) -> None:
        """The operator deletes conntrack entries after each start of a sandbox with UDP ports."""
        flushes = {own.place: box for box, own in self.own(role=ROLE_FLUSH)}
        assert len(flushes) == len(self.boxes(role=ROLE_FLUSH)), "a place has at most one record"
        for sandbox, own in self.own("running", role=ROLE_SANDBOX):
            if sandbox.udp and self.engine.image:
                assert flushes[own.place].started > sandbox.started

    def routers_wanted(self, live: list[Member]) -> dict[tuple[int, Place], set[str]]:
        """The routers that lead to the proxy for rmw_zenoh, by network namespace."""
        boxes = {box.id: box for box in self.engine.boxes}
        wanted: dict[tuple[int, Place], set[str]] = {}
        for member in live if self.engine.image else ():
            home = boxes.get(member.container.network_container or "", boxes[member.container.id])
            near = [b for b in boxes.values() if home in (b, self.engine.home(b))]
            if (
                member.place == ZENOH
                and {home.state, member.container.state} <= STARTED
                and not any(box.is_router and box.state in ALIVE for box in near)
            ):
                routers = wanted.setdefault((home.namespace, ZENOH), {"127.0.0.1:7447"})
                networks = [self.engine.networks[n] for n in home.networks]
                is_given = "ZENOH_CONFIG_OVERRIDE" in member.container.variables
                if is_given and not all(network.internal for network in networks):
                    routers.add("192.0.2.7:7447")
        return wanted

    def check_routers(self, wanted: dict[tuple[int, Place], set[str]]) -> None:
        """Each network namespace has a separate port of the proxy."""
        runs = [
            (box, own) for box, own in self.own("running", role=ROLE_PROXY) if own.place == ZENOH
        ]
        for proxy, own in runs:
            box = self.engine.home(proxy)
            if not box or box.state != "running":
                continue
            rules = [self.engine.rules[site] for site in wanted]
            assert [{*map(str, routers)} for routers, _ in rules] == [*wanted.values()]
            leads = [target for _, target in rules if target]
            assert {target.host for target in leads} <= {box.address}
            assert all(target.port in own.range for target in leads)
            assert len({target.port for target in leads}) == len(leads) == len(wanted)

    def check_redirects(self, live: list[Member]) -> None:
        """Only containers with an address in ROS_MASTER_URI have a redirect, to the right proxy."""
        boxes = {box.id: box for box in self.engine.boxes}
        routers = self.routers_wanted(live)
        self.check_routers(routers)
        wanted = {}
        for member in live:
            home = boxes.get(member.container.network_container or "", boxes[member.container.id])
            given = member.container.master_uri.removeprefix("http://") if self.engine.image else ""
            # The engine removes a network under a container that does not run.
            joined = [self.engine.networks[n] for n in home.networks if n in self.engine.networks]
            if (
                given.startswith("192.")
                and member.place.graph == Master(f"http://{given}")
                and {home.state, member.container.state} <= STARTED
                and member.container.labels.get("rosproxy.redirect") != "false"
                and self.controller.settings.redirect
                and not all(network.internal for network in joined)
            ):
                wanted[home.namespace, member.place] = given
        runs = {
            own.place: box
            for proxy, own in self.own("running", role=ROLE_PROXY)
            if (box := self.engine.home(proxy)) and box.state == "running"
        }
        live_namespaces = {
            home.namespace: home.id for home in boxes.values() if home.state in STARTED
        }
        if self.engine.image:
            for (namespace, place), rule in self.engine.rules.items():
                site = namespace, place
                expected = site in wanted or site in routers or site in self.forgotten
                assert namespace not in live_namespaces or expected, rule
        for (namespace, place), given in wanted.items():
            if sandbox := runs.get(place):  # otherwise the redirect stays, or comes later
                (master,), proxy = self.engine.rules[namespace, place]
                assert str(master) == given
                assert proxy == HostPort(sandbox.address, 11402)
        records = [box.mode for box in self.boxes(role=ROLE_REDIRECT)]
        assert len(records) <= len(wanted) + len(routers) or not self.engine.image

    def made(self, place: Place, members: list[Member]) -> Create:
        """The expected proxy of these containers, except the range."""
        told = {peer for member in members for peer in member.peers}
        peers = tuple(sorted(told)) if place.graph.ros != "1" else ()
        spec = proxy_spec(place, members, SETTINGS)
        links = tuple(sorted({link for member in members for link in member.links}))
        return Create("", place, PortRange(0, 0), "", spec, peers=peers, links=links)

    def check_place(self, place: Place, wanted: set[str], made: Create) -> None:
        every = [(box, own) for box, own in self.own() if own.place == place]
        own = [(box, own) for box, own in every if own.role not in (ROLE_REDIRECT, ROLE_FLUSH)]
        if any(box.state == "restarting" and box.role == ROLE_SANDBOX for box, _ in own):
            return
        roles = [own.role for _, own in own]
        is_ros2 = place.graph.ros == "2"
        has_lan_relay = is_ros2 and (bool(self.engine.image) or ROLE_LAN_RELAY in roles)
        assert sorted(roles) == [ROLE_LAN_RELAY] * has_lan_relay + [ROLE_SANDBOX, ROLE_PROXY]
        *lan_relays, (sandbox, is_), (proxy, runs) = sorted(own, key=lambda pair: pair[0].role)
        assert sandbox.state == "running"
        assert proxy.state in ("running", "restarting")
        assert set(sandbox.networks) == {SETTINGS.uplink, *wanted}
        assert self.is_named(sandbox, sandbox_name(place))
        assert self.is_named(proxy, proxy_name(place))
        assert self.engine.home(proxy) is sandbox
        assert proxy.namespace == sandbox.namespace or proxy.state == "restarting"
        assert runs.range == is_.range
        near = HostPort(GATEWAY, is_.range.last)
        for lan_relay, hears in lan_relays:
            self.check_lan_relay(lan_relay, hears, sandbox, near)
        if self.engine.image:
            box = CreateSandbox("", place, is_.range, made.spec)
            assert is_.fingerprint == sandbox_fingerprint(box, SETTINGS)
            made = structs.replace(made, range=is_.range, lan_relay=near if is_ros2 else None)
            assert runs.fingerprint == proxy_fingerprint(made, SETTINGS, self.engine.image, "")

    def check_lan_relay(
        self, lan_relay: Box, hears: OwnLabels, sandbox: Box, near: HostPort
    ) -> None:
        """The LAN relay runs, and knows the address of the proxy."""
        assert lan_relay.state in ("running", "restarting")
        assert self.is_named(lan_relay, lan_relay_name(hears.place))
        if self.engine.image:
            proxy = HostPort(sandbox.address, hears.range.first)
            made = CreateLanRelay("", hears.place, hears.range, HERE, near, proxy)
            assert hears.fingerprint == lan_relay_fingerprint(made, SETTINGS, self.engine.image, "")

    def is_named(self, box: Box, name: str) -> bool:
        """Whether the container has the name, unless another container has."""
        return (box.name == name) != any(stranger.name == name for stranger in self.strangers())

    def check_names(self, member: Member, networks: frozenset[str]) -> None:
        """The name in ROS_MASTER_URI leads to the proxy of the container alone."""
        for network in networks if member.wanted_alias else ():
            answering = [
                box.own.place if box.own else box.name
                for box in self.engine.boxes
                if network in box.networks
                and member.wanted_alias in box.networks[network][1] | {box.name}
                and box.state not in ("dead", "removing")
            ]
            restarting = [own.place for _, own in self.own("restarting", role=ROLE_SANDBOX)]
            assert answering == [member.place] or member.place in restarting
