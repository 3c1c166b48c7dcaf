"""A simulated engine: the effects of actions on a host, and forbidden actions."""

import itertools
from dataclasses import dataclass, field, replace
from functools import lru_cache

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortRange
from rosproxy_operator.docker.planner.actions import (
    Action,
    Connect,
    Create,
    CreateFlush,
    CreateLanRelay,
    CreateNetwork,
    CreateRedirect,
    CreateSandbox,
    Disconnect,
    Remove,
    RemoveNetwork,
    Rename,
    Restart,
    Run,
    Start,
    Unpause,
)
from rosproxy_operator.docker.planner.model import (
    STARTED,
    Attachment,
    Container,
    FlushContainer,
    HostState,
    LanRelayContainer,
    Network,
    Proxy,
    RedirectContainer,
    Sandbox,
)
from rosproxy_operator.docker.planner.own_containers import has_own_name
from rosproxy_operator.docker.planner.plan import DockerPlan
from rosproxy_operator.docker.planner.specs import (
    ROLE_FLUSH,
    ROLE_LAN_RELAY,
    ROLE_PROXY,
    ROLE_REDIRECT,
    ROLE_SANDBOX,
    Creation,
    OwnLabels,
    own_labels,
    published_ports,
    read_own,
)
from rosproxy_operator.docker.planner.state import DockerMemory
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.place import Place
from tests.unit.operator.docker.builders import planned

SERVING = {"running", "paused", "restarting"}
GATEWAY = "172.30.0.1"
"""The gateway of the uplink, if the uplink exists."""


class Failed(Exception):
    """The engine cannot do an action."""


class Refused(Failed):
    """The engine cannot start a container, because a port is taken."""

    def __init__(self, port: int | None) -> None:
        super().__init__(f"a port is taken: {port}")
        self.port = port


@lru_cache(maxsize=4096)
def _own(name: str, labels: tuple[tuple[str, str], ...]) -> OwnLabels | None:
    own = read_own(dict(labels))
    return own if own and has_own_name(own, name) else None


@dataclass
class Box:
    """A container of the engine. ``networks`` holds ids and names by network.

    ``namespace`` is the time of origin of the network namespace: for a proxy, the sandbox's start.
    ``redirect`` is the change to the rules in another container's namespace.
    """

    id: str
    name: str
    state: str = "created"
    labels: dict[str, str] = field(default_factory=dict)
    networks: dict[str, tuple[str, frozenset[str]]] = field(default_factory=dict)
    env: str = ""
    ports: frozenset[int] = frozenset()
    udp: frozenset[int] = frozenset()
    mode: str = ""
    started: int = 0
    namespace: int = 0
    redirect: CreateRedirect | None = None
    exit_code: int = 0
    variables: dict[str, str] = field(default_factory=dict)
    is_router: bool = False

    @property
    def own(self) -> OwnLabels | None:
        """The operator's labels, if the name agrees. The simulation knows no other sign of
        forgery.
        """
        return _own(self.name, tuple(self.labels.items()))

    @property
    def role(self) -> str:
        return self.own.role if self.own else ""

    @property
    def address(self) -> str:
        """The address on all networks, which changes with each start."""
        return f"172.30.{self.started // 250}.{2 + self.started % 250}" if self.started else ""

    @property
    def started_at(self) -> str:
        return f"2026-01-01T00:00:00.{self.started:06d}".rstrip("0") + "Z"


class Engine:
    """A Docker host. ``open`` and ``hidden`` are ports of other programs. The operator sees only
    ``open``. ``names_ports``: refusals name the port.
    """

    def __init__(self, settings: PlanSettings, ephemeral: PortRange) -> None:
        self.settings = settings
        self.ephemeral = ephemeral
        self.boxes: list[Box] = []
        self.networks: dict[str, Network] = {}
        self.open: set[int] = set()
        self.hidden: set[int] = set()
        self.image = "image-1"
        self.names_ports = True
        self.redirects_fail = False
        self.rules: dict[tuple[int, Place], tuple[tuple[HostPort, ...], HostPort | None]] = {}
        self.uninstalls = False
        self.ids = itertools.count()

    # what users do

    def add_network(self, name: str, internal: bool = False) -> None:
        gateway = GATEWAY if name == self.settings.uplink else ""
        self.networks[name] = Network(f"net-{next(self.ids)}", name, "bridge", internal, gateway)

    def add(self, name: str, **more: object) -> Box:
        box = Box(f"box-{next(self.ids)}", name)
        for attribute, value in more.items():
            setattr(box, attribute, value)
        self.boxes.append(box)
        return box

    def join(self, box: Box, network: str, *names: str) -> None:
        network_id = self.networks[network].id if box.state in SERVING | {"exited"} else ""
        box.networks[network] = network_id, frozenset({box.name, *names})

    def active(self, network: str) -> bool:
        """Whether a running container is on a network, so that the network cannot be removed."""
        return any(network in box.networks and box.state in SERVING for box in self.boxes)

    def conflicts(self, box: Box) -> set[int]:
        """The ports of a container that something else holds."""
        others = [other for other in self.boxes if other is not box and other.state in SERVING]
        tcp = {port for other in others for port in other.ports} | self.open | self.hidden
        udp = {port for other in others for port in other.udp} | self.open | self.hidden
        return set(box.ports) & tcp | set(box.udp) & udp

    # what the operator sees

    def observe(self) -> HostState:
        started = [box for box in self.boxes if box.state in STARTED]
        tcp_ports = {port for box in started for port in box.ports}
        # As in `snapshot.foreign_ports`, the port of a LAN relay is not told.
        udp_ports = {port for box in started if box.role != ROLE_LAN_RELAY for port in box.udp}
        own = [(box, box.own) for box in self.boxes]
        return HostState(
            containers=tuple(self._container(box) for box, role in own if role is None),
            networks=tuple(self.networks.values()),
            proxies=tuple(
                Proxy(is_.place, self._container(box), is_.range, is_.fingerprint)
                for box, is_ in own
                if is_ and is_.role == ROLE_PROXY
            ),
            ephemeral=self.ephemeral,
            listening=frozenset(self.open | tcp_ports),
            listening_udp=frozenset(self.open | udp_ports),
            lan_relays=tuple(
                LanRelayContainer(is_.place, self._container(box), is_.range, is_.fingerprint)
                for box, is_ in own
                if is_ and is_.role == ROLE_LAN_RELAY
            ),
            flushes=tuple(
                FlushContainer(is_.place, self._container(box), is_.range, is_.fingerprint)
                for box, is_ in own
                if is_ and is_.role == ROLE_FLUSH
            ),
            redirects=tuple(
                RedirectContainer(is_.place, self._container(box), is_.range, is_.fingerprint)
                for box, is_ in own
                if is_ and is_.role == ROLE_REDIRECT
            ),
            image_id=self.image,
            sandboxes=tuple(
                Sandbox(is_.place, self._container(box), is_.range, is_.fingerprint)
                for box, is_ in own
                if is_ and is_.role == ROLE_SANDBOX
            ),
        )

    def _container(self, box: Box) -> Container:
        running = box.state in STARTED
        attachments = tuple(
            Attachment(name, box.address if running else "", names | {box.name}, network_id)
            for name, (network_id, names) in box.networks.items()
        )
        return Container(
            id=box.id,
            name=box.name,
            state=box.state,
            labels=dict(box.labels),
            network_mode=box.mode,
            attachments=attachments,
            master_uri=box.env,
            host_ports=box.ports,
            udp_ports=box.udp,
            started_at=box.started_at,
            exit_code=box.exit_code,
            variables=dict(box.variables),
            is_zenoh_router=box.is_router,
            forged="" if box.own or read_own(box.labels) is None else "the name is not its own",
        )

    # what the operator does

    def apply(self, action: Action) -> None:  # noqa: C901, PLR0912 - one case per action
        """Raises Failed. An AssertionError means that the plan is wrong in itself."""
        match action:
            case CreateNetwork() | RemoveNetwork() | Connect() | Disconnect():
                self._apply_to_network(action)
            case CreateSandbox() | Create() | CreateLanRelay() | CreateRedirect() | CreateFlush():
                self._create(action)
            case Run(name):
                self._run(self.own(name))
            case Start(name):
                self.start(self.own(name))
            case Restart(name):
                box = self.own(name)
                assert box.role == ROLE_PROXY
                box.state = "exited"
                self.start(box)
            case Unpause(name):
                box = self.own(name)
                if box.state != "paused":
                    raise Failed("not paused")
                box.state = "running"
            case Rename(name, to):
                box = self.own(name)
                if self.named(to):
                    raise Failed(f"{to} exists")
                box.name = to
            case Remove(name) if [box.state for box in self.named(name)] == ["removing"]:
                assert self.uninstalls
            case Remove(name):
                self.boxes.remove(self.own(name))

    def _apply_to_network(
        self, action: CreateNetwork | RemoveNetwork | Connect | Disconnect
    ) -> None:
        match action:
            case CreateNetwork(name):
                if name in self.networks:
                    raise Failed(f"network {name} exists")
                self.add_network(name)
                self.networks[name] = replace(self.networks[name], made_by_operator=True)
            case RemoveNetwork(name):
                assert self.networks[name].made_by_operator
                if self.active(name):
                    raise Failed("has active endpoints")
                del self.networks[name]
            case Connect(name, network, aliases):
                self._connect(self.own(name), network, aliases)
            case Disconnect(name, network):
                box = self.own(name)
                if network not in box.networks or network not in self.networks:
                    raise Failed("not connected")
                del box.networks[network]

    def own(self, name: str) -> Box:
        """A container to do something to, which must be the operator's own."""
        boxes = self.named(name)
        if not boxes:
            raise Failed(f"no container {name}")
        assert boxes[0].own is not None, f"{name} is not the operator's"
        assert boxes[0].state != "removing"
        return boxes[0]

    def named(self, name: str) -> list[Box]:
        return [box for box in self.boxes if box.name == name]

    def _create(self, action: Creation) -> None:
        name = action.name
        labels = own_labels(action)
        uplink = self.settings.uplink
        if self.named(name) or not self.image:
            raise Failed(f"can't create {name}")
        if isinstance(action, CreateSandbox):
            if uplink not in self.networks:
                raise Failed("no uplink")
            published = published_ports(action.place, action.range, action.spec.udp)
            tcp = frozenset(port for exposed, port in published if exposed.endswith("/tcp"))
            udp = frozenset(port for exposed, port in published if exposed.endswith("/udp"))
            self.join(self.add(name, labels=labels, ports=tcp, udp=udp), uplink)
        elif isinstance(action, CreateLanRelay):
            self.add(name, labels=labels, udp=frozenset({action.bind.port}), mode="host")
        elif isinstance(action, CreateFlush):
            self.add(name, labels=labels, mode="host")
        elif isinstance(action, CreateRedirect):
            if action.target not in {box.id for box in self.boxes}:
                raise Failed("no such container")
            self.add(name, labels=labels, mode=f"container:{action.target}", redirect=action)
        else:
            home = self.own(action.sandbox)
            assert home.role == ROLE_SANDBOX
            self.add(name, labels=labels, mode=f"container:{home.id}")

    def start(self, box: Box) -> None:
        if box.state not in {"created", "exited"}:
            raise Failed(f"{box.name} is {box.state}")
        for name, (network_id, _) in box.networks.items():
            if name not in self.networks or network_id not in ("", self.networks[name].id):
                raise Failed(f"network {name} not found")
        taken = self.conflicts(box)
        if box.role in (ROLE_REDIRECT, ROLE_FLUSH):
            self._run(box)
            return
        if box.role != ROLE_LAN_RELAY and taken:
            raise Refused(min(taken) if self.names_ports else None)
        home = self.home(box)
        shares = box.mode.startswith("container:")
        if shares and (home is None or home.state not in STARTED):
            raise Failed("cannot join network of a non running container")
        box.state = "restarting" if taken else "running"  # a LAN relay binds the port itself
        box.started = next(self.ids)
        box.namespace = home.namespace if home else box.started
        box.networks = {n: (self.networks[n].id, names) for n, (_, names) in box.networks.items()}

    def _run(self, box: Box) -> None:
        """Run a container that does a single thing and ends. Raises Failed."""
        if box.role == ROLE_FLUSH:
            box.state = "exited"
            box.started = next(self.ids)
            return
        home = self.home(box)
        if home is None or home.state not in STARTED:
            raise Failed("cannot join network of a non running container")
        assert home.own is None, "only users' containers are redirected"
        assert box.redirect is not None
        box.state = "exited"
        box.exit_code = int(self.redirects_fail)
        box.namespace = home.namespace
        if self.redirects_fail:
            raise Failed("ended with 1")
        site = home.namespace, box.redirect.place
        self.rules[site] = box.redirect.addresses, box.redirect.proxy
        if not box.redirect.addresses:
            del self.rules[site]

    def begin(self, box: Box, state: str) -> None:
        """Give a user's container a state. Each start makes a new namespace."""
        if state in STARTED and box.state not in STARTED:
            box.started = next(self.ids)
            box.namespace = box.started
        box.state = state

    def home(self, box: Box) -> Box | None:
        """The container whose network namespace `box` shares."""
        return next((owner for owner in self.boxes if box.mode == f"container:{owner.id}"), None)

    def _connect(self, box: Box, network: str, aliases: tuple[str, ...]) -> None:
        if network not in self.networks:
            raise Failed(f"no network {network}")
        if network in box.networks and box.state != "created":
            raise Failed("already connected")
        uplink = self.settings.uplink
        assert box.role == ROLE_SANDBOX
        assert self.networks[network].internal or network >= uplink, "moves the published ports"
        for alias in aliases:
            strangers = [
                stranger.name
                for stranger in self.boxes
                if stranger.own is None
                and network in stranger.networks
                and alias in stranger.networks[network][1]
                and stranger.state not in ("dead", "removing")
            ]
            assert not strangers, f"{alias} on {network} is that of {strangers}"
        self.join(box, network, *aliases)


class Controller:
    """The operator that plans, carries out and may be killed anywhere."""

    def __init__(self, engine: Engine, settings: PlanSettings) -> None:
        self.engine = engine
        self.settings = settings
        self.memory = DockerMemory()
        self.now = 1000.0

    def look(self) -> DockerPlan:
        plan = planned(self.engine.observe(), self.settings, self.memory, self.now)
        self.memory = plan.memory
        return plan

    def carry_out(self, plan: DockerPlan, most: int | None = None) -> list[tuple[Action, Failed]]:
        """Carry out a plan's actions, or the first few. What fails is returned."""
        failed: list[tuple[Action, Failed]] = []
        left = len(plan.actions) if most is None else most
        for group in plan.groups:
            for action in group.actions:
                if left <= 0:
                    return failed
                left -= 1
                if error := self._try(action):
                    failed.append((action, error))
                    if not isinstance(action, Connect | Disconnect):
                        break
        return failed

    def _try(self, action: Action) -> Failed | None:
        try:
            self.engine.apply(action)
        except Refused as error:
            assert isinstance(action, Start)
            self.memory = self.memory.with_refusal(action.name, error.port, self.now)
            return error
        except Failed as error:
            return error
        return None
