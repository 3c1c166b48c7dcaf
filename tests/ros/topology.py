"""A network with a boundary: machines outside, machines inside, NAT between them.

Every machine is a network namespace with a different host name and `/etc/hosts`, so that a host
name may be known on a single machine only.

    out (roscore, outside nodes) -- LAN -- host (NAT, published ports) -- bridge -- px, c1, c2

The host drops traffic from outside to inside, except to ports that are published to `px`. Inside
gets out through masquerade only. Docker's bridge network does the same.

In an isolated plan only the proxy gets out: other inside machines have no route, and the host does
not forward for them.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

OUT_HOST = "10.77.0.1"
OUT_NODE = "10.77.0.2"
ADVERTISED_NAME = "dockerhost"
"""A name of the host that outside machines know. `OUT_HOST` is the address."""
MASTER_PORT = 11311
PUBLISHED_MASTER_PORT = 11411

_PREFIX = "rost"
_NETNS_ETC = Path("/etc/netns")
_CLONE_NEWNET = 0x40000000


class PortMap(NamedTuple):
    """The ports that the proxy binds, and the host ports that lead there."""

    first: int
    last: int
    published_first: int

    @property
    def bound(self) -> str:
        return f"{self.first}-{self.last}"

    @property
    def published(self) -> str:
        offset = self.published_first - self.first
        return f"{self.first + offset}-{self.last + offset}"

    def pairs(self) -> list[tuple[int, int]]:
        """(host port, proxy port) for each published port."""
        offset = self.published_first - self.first
        return [(port + offset, port) for port in range(self.first, self.last + 1)]


@dataclass(frozen=True)
class SecondProxy:
    """The machine px2: the numbers of its inside networks, and its ports.

    The host publishes the ports if px2 has a way out without px.
    """

    networks: tuple[int, ...]
    ports: PortMap

    @property
    def behind_first(self) -> bool:
        """Whether px is the only way outside."""
        return 1 in self.networks


@dataclass(frozen=True)
class Plan:
    """The plan of a topology: inside networks, ports, and the boundary.

    With `flat`, nothing separates the machines and every name resolves everywhere. Then nodes work
    without a proxy, which proves that a test and its nodes are sound. With `alias`, the master's
    host name leads inside to the proxy, like a network alias of Docker, also on the proxy's
    machine. With `hairpin`, inside also reaches the published ports at the host's address, as with
    Docker's proxy process. Without, a wrong address for inside fails a test. With `forwarding`, the
    proxy's machine forwards, like containers of Docker. The kernel plane needs that. Without, every
    topic goes through the proxy in user space. With `isolated`, inside has no way out but the
    proxy. With `second`, there is another proxy, and px is only on the first network. `host` and
    `robot` are the addresses of the machines host and out on the LAN.
    """

    name: str
    networks: tuple[tuple[str, ...], ...]
    ports: PortMap
    flat: bool = False
    alias: bool = False
    hairpin: bool = False
    forwarding: bool = False
    isolated: bool = False
    second: SecondProxy | None = None
    host: str = OUT_HOST
    robot: str = OUT_NODE


SHARED = Plan("s", (("c1", "c2"),), PortMap(45000, 45099, 45000))
SPLIT = Plan("d", (("c1",), ("c2",)), PortMap(45000, 45029, 46000))
ALIAS = Plan("a", (("c1", "c2"),), PortMap(11500, 11599, 11500), alias=True)


@dataclass
class Place:
    """A machine: a network namespace with a host name and addresses."""

    role: str
    namespace: str
    hostname: str
    addresses: list[str] = field(default_factory=list)

    @property
    def address(self) -> str:
        return self.addresses[0]

    def command(self, argv: Sequence[str]) -> list[str]:
        """The command line that runs `argv` on this machine, as the same single process."""
        name = 'hostname "$0" && exec "$@"'
        enter = ["ip", "netns", "exec", self.namespace, "unshare", "--uts", "sh", "-c", name]
        return [*enter, self.hostname, *argv]

    @contextlib.contextmanager
    def entered(self) -> Iterator[None]:
        """Makes the sockets that this thread opens belong to this machine."""
        with open("/proc/self/ns/net") as before, open(f"/run/netns/{self.namespace}") as here:
            _set_network(here.fileno())
            try:
                yield
            finally:
                _set_network(before.fileno())


class Topology:
    """The machines of a plan. `build` makes and `remove` removes the machines."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.places: dict[str, Place] = {}
        proxies = ("px", "px2") if plan.second else ("px",)
        for role in ("out", "host", *proxies, *(c for network in plan.networks for c in network)):
            hostname = {"out": "robot", "px": "rosproxy", "px2": "rosproxy2"}.get(
                role, f"{role}box"
            )
            self.places[role] = Place(role, self._namespace(role), hostname)

    def _namespace(self, role: str) -> str:
        return f"{_PREFIX}{os.getpid()}{self.plan.name}-{role}"

    def build(self) -> None:
        """Lays out every namespace, link, route, rule and hosts file."""
        for place in self.places.values():
            ip("netns", "add", place.namespace)
            ip("-n", place.namespace, "link", "set", "lo", "up")
        self._connect()
        for place in self.places.values():
            self._write_names(place)

    def remove(self) -> None:
        """Kills all processes in the namespaces, and deletes the namespaces."""
        for place in self.places.values():
            _remove_namespace(place.namespace)

    def _connect(self) -> None:
        self._join_outside()
        for number, members in enumerate(self.plan.networks, start=1):
            self._join_inside(number, members)
        self._load_rules()
        if self.plan.alias:
            self._keep_ports_free()

    def _join_outside(self) -> None:
        self._add_bridge("out0", self.plan.host)
        self._link("out", "eth0", "lan1", f"{self.plan.robot}/24", "out0")
        # A route to inside exists on purpose: what stops outside is the host's policy.
        ip("-n", self.places["out"].namespace, "route", "add", "default", "via", self.plan.host)
        self.places["host"].addresses.append(self.plan.host)

    def _join_inside(self, number: int, members: tuple[str, ...]) -> None:
        bridge = f"br{number}"
        subnet = f"172.30.{number}"
        self._add_bridge(bridge, f"{subnet}.1")
        for role in (*self._proxies_on(number), *members):
            last = {"px": 2, "px2": 3}.get(role) or 10 + int(role[1:])
            port = f"{role}-{number}"
            device = f"eth{len(self.places[role].addresses)}"
            self._link(role, device, port, f"{subnet}.{last}/24", bridge)
            if device == "eth0" and (role.startswith("px") or not self.plan.isolated):
                gateway = ("default", "via", f"{subnet}.1")
                ip("-n", self.places[role].namespace, "route", "add", *gateway)

    def _proxies_on(self, number: int) -> list[str]:
        second = self.plan.second
        first = ["px"] if second is None or number == 1 else []
        return [*first, "px2"] if second and number in second.networks else first

    def _leaving(self) -> list[str]:
        """The proxies that get outside by themselves where the plan is isolated."""
        second = self.plan.second
        return ["px", "px2"] if second and not second.behind_first else ["px"]

    def _add_bridge(self, bridge: str, address: str) -> None:
        self._on_host("link", "add", bridge, "type", "bridge")
        self._on_host("addr", "add", f"{address}/24", "dev", bridge)
        self._on_host("link", "set", bridge, "up")

    def _link(self, role: str, device: str, host_device: str, address: str, bridge: str) -> None:
        place = self.places[role]
        peer = ("peer", "name", device, "netns", place.namespace)
        self._on_host("link", "add", host_device, "type", "veth", *peer)
        self._on_host("link", "set", host_device, "master", bridge, "up")
        give(place, device, address)

    def _on_host(self, *arguments: str) -> None:
        ip("-n", self.places["host"].namespace, *arguments)

    def _load_rules(self) -> None:
        host = self.places["host"].namespace
        self._forward("host", True)
        self._forward("px", self.plan.forwarding or os.environ.get("ROS_TESTS_KERNEL") == "1")
        if not self.plan.flat:
            rules = boundary_rules(
                self.plan, [self.places[role].address for role in self._leaving()]
            )
            run_command("ip", "netns", "exec", host, "nft", "-f", "-", text=rules)

    def _forward(self, role: str, forwards: bool) -> None:
        sysctl(self.places[role], f"net.ipv4.ip_forward={forwards:d}")

    def _keep_ports_free(self) -> None:
        """Keeps the proxy's own connections off the ports that nodes on the robot may have."""
        sysctl(self.places["px"], "net.ipv4.ip_local_port_range=1024 11000")

    def _write_names(self, place: Place) -> None:
        folder = _NETNS_ETC / place.namespace
        folder.mkdir(parents=True, exist_ok=True)
        lines = [f"{address} {name}" for address, name in self._known_names(place)]
        (folder / "hosts").write_text("127.0.0.1 localhost\n" + "\n".join(lines) + "\n")
        # No DNS: an unknown name fails at once, as with a container network's DNS.
        (folder / "nsswitch.conf").write_text("hosts: files\n")

    def _known_names(self, place: Place) -> Iterator[tuple[str, str]]:
        others = self.places.values() if self.plan.flat else [place]
        yield from ((other.address, other.hostname) for other in others)
        if not self.plan.flat:
            yield self.plan.host, ADVERTISED_NAME
            inside = place.role == "px" or place.role.startswith("c")
            hidden = self.plan.alias and inside
            robot = self._proxy_address(place) if hidden else self.plan.robot
            yield robot, self.places["out"].hostname
        if place.role.startswith("c"):
            yield self._proxy_address(place), "rosproxy"

    def _proxy_address(self, place: Place) -> str:
        subnet = place.address.rpartition(".")[0]
        proxies = [self.places[role] for role in ("px", "px2") if role in self.places]
        addresses = (a for proxy in proxies for a in proxy.addresses if a.startswith(f"{subnet}."))
        return next(addresses)


def boundary_rules(plan: Plan, proxies: list[str]) -> str:
    """The rules of nft by which the host publishes ports to proxies, and lets nothing else in."""
    come = "" if plan.hairpin else 'iifname "out0"'
    master = (PUBLISHED_MASTER_PORT, PUBLISHED_MASTER_PORT)
    published = [[*plan.ports.pairs(), master], plan.second.ports.pairs() if plan.second else []]
    lead = "\n".join(
        f"ip daddr {plan.host} {come} meta l4proto {{ tcp, udp }} dnat ip to {proxy} : "
        f"th dport map {{ {', '.join(f'{host} : {bound}' for host, bound in pairs)} }}"
        for proxy, pairs in zip(proxies, published, strict=False)
    )
    leaves = f"{{ {', '.join(proxies)} }}" if plan.isolated else "172.30.0.0/16"
    return f"""
    table ip boundary {{
      chain published {{
        type nat hook prerouting priority dstnat;
        {lead}
      }}
      chain leaving {{
        type nat hook postrouting priority srcnat;
        ip saddr {leaves} oifname "out0" masquerade
        ip saddr 172.30.0.0/16 ct status dnat masquerade
      }}
      chain forward {{
        type filter hook forward priority filter; policy drop;
        ct state established,related accept
        ct status dnat accept
        iifname "br*" ip saddr {leaves} oifname "out0" accept
        iifname "out0" oifname "out0" accept
        iifname "br1" oifname "br1" accept
        iifname "br2" oifname "br2" accept
      }}
    }}
    """


def remove_leftovers(prefix: str = _PREFIX) -> None:
    """Removes the namespaces of killed test runs.

    The names of namespaces have the prefix, then the process id. A lock protects against other runs
    that start at the same moment.
    """
    with Path("/run/lock/rosproxy-tests-leftovers").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        listed = run_command("ip", "netns", "list")
        for namespace, pid in re.findall(rf"^({prefix}(\d+)\S+)", listed, re.MULTILINE):
            if not Path(f"/proc/{pid}").exists():
                _remove_namespace(namespace)


def _remove_namespace(namespace: str) -> None:
    if Path(f"/run/netns/{namespace}").exists():
        _kill_all(namespace)
        ip("netns", "del", namespace)
    shutil.rmtree(_NETNS_ETC / namespace, ignore_errors=True)


def _kill_all(namespace: str) -> None:
    deadline = time.monotonic() + 30
    while pids := run_command("ip", "netns", "pids", namespace).split():
        for pid in pids:
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(pid), signal.SIGKILL)
        if time.monotonic() > deadline:
            raise TimeoutError(f"processes in {namespace} do not end: {pids}")
        time.sleep(0.02)


def _set_network(descriptor: int) -> None:
    if ctypes.CDLL(None, use_errno=True).setns(descriptor, _CLONE_NEWNET) != 0:
        raise OSError(ctypes.get_errno(), "setns")


def ip(*arguments: str) -> None:
    """Runs ip(8)."""
    run_command("ip", *arguments)


def give(place: Place, device: str, address: str, *flags: str) -> None:
    """Gives a device an address with the prefix length of its network, and sets the device up."""
    ip("-n", place.namespace, "addr", "add", address, "dev", device, *flags)
    ip("-n", place.namespace, "link", "set", device, "up")
    place.addresses.append(address.partition("/")[0])


def sysctl(place: Place, setting: str) -> None:
    """Sets a parameter of a namespace, as ``name=value``."""
    run_command("ip", "netns", "exec", place.namespace, "sysctl", "-q", "-w", setting)


def run_command(*argv: str, text: str | None = None) -> str:
    """The output of a program. Raises RuntimeError after a failure."""
    done = subprocess.run(argv, input=text, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(argv)}: {done.stderr.strip()[:500]}")
    return done.stdout
