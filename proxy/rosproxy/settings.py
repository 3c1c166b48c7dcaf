"""The settings of a proxy: plain data, checked.

``read_…`` makes one value of a text, as it comes from a command line, an environment or a label,
and raises ValueError with what is wrong and an example. `make_settings` puts values together and
raises SettingError where they don't go together.
"""

import hashlib
import json
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from ipaddress import ip_address, ip_network
from typing import Any, Literal, TypeVar

from rosproxy.access.layers import PolicyLayer, PolicyMode, check_bounds, read_layers
from rosproxy.access.rules import Rule
from rosproxy.leases.ports import PortMap, PortRange
from rosproxy.net import addresses
from rosproxy.net.addresses import HostPort, Network, parse_host_port

MEBIBYTE = 1024 * 1024
LEAST_PER_DOMAIN = 4
"""Ports of the range for a domain of ROS 2: one to be found at, three for a participant."""
DEFAULT_ADMIN = HostPort("127.0.0.1", 11312)
DataPlane = Literal["auto", "kernel", "splice", "copy"]
"""How topics' bytes are forwarded: by the kernel, spliced, or copied; auto: the best possible."""
Direction = Literal["out", "both"]
"""Who reaches the other side through the proxy: outside alone, or the nodes inside, too."""
SlaveControl = Literal["any", "master"]
"""Who may call shutdown, publisherUpdate and paramUpdate at inside nodes."""

_Value = TypeVar("_Value")
_RANGE = re.compile(r"\s*([0-9]{1,5})\s*-\s*([0-9]{1,5})\s*")
_TOKEN = re.compile(r"[!-~]{8,200}")
_HASH = re.compile(r"[0-9a-f]{64}")
_LONGEST = 40
"""Characters of a bad value that a message repeats."""


class SettingError(ValueError):
    """A setting that can't be used. ``option`` names it as on the command line."""

    def __init__(self, option: str, problem: str) -> None:
        super().__init__(f"{option}: {problem}")
        self.option = option


@dataclass(frozen=True, slots=True)
class Settings:
    """Everything that ``rosproxy run`` can be told. Times are in seconds.

    ``inside_networks`` empty means: the networks of the proxy's own interfaces, with ``direction``
    ``both`` without that of the default route if there are others.
    ``master_address``: the IP address of the master's host where the proxy can't resolve its name
    or would find itself. ``direction`` ``both``: nodes inside reach those outside through the
    proxy, too; ``udp``: the range is published for UDP as well. ``admin_token``: what callers that
    are not on loopback must know, or ``admin_token_hash``: its SHA-256 in hex digits, for a proxy
    that is not to hold the token.
    ``ros`` are the versions of ROS that it is for, 1 or 2 or both. Of ROS 2: ``ros2_domain`` are
    the domains, which share the range out among them (none: domain 0), ``ros2_peer`` who outside is
    told of participants inside (with port 0 at the well-known ports), ``ros2_ear`` where the ear
    listens.
    ``policy`` are the layers of the options, in ``policy_mode`` as is that of the ``policy_file``;
    ``policy_layers`` are those that an operator gives for the start, ``await_policy`` is how long
    nothing is registered then, unless the operator has told the present ones before.
    Raises SettingError if two of them want the same port, or both a token and a hash are given.
    """

    master_uri: str
    advertise_host: str
    ports: PortMap
    ros: tuple[str, ...] = ("1",)
    ros2_domain: tuple[int, ...] = ()
    ros2_peer: tuple[HostPort, ...] = ()
    ros2_ear: HostPort | None = None
    master_port: int = 11311
    publish_master: int | None = None
    bind: str = "0.0.0.0"
    admin: HostPort = DEFAULT_ADMIN
    inside_networks: tuple[Network, ...] = ()
    probe_interval: float = 5.0
    probe_timeout: float = 3.0
    cleanup_after: float = 30.0
    linger: float = 30.0
    master_interval: float = 2.0
    slave_control: SlaveControl = "any"
    data_plane: DataPlane = "auto"
    direction: Direction = "out"
    udp: bool = False
    master_address: str | None = None
    admin_token: str | None = field(default=None, repr=False)
    admin_token_hash: str | None = None
    max_lease_call: int = 1
    max_master_call: int = 4
    max_body: int = 64
    max_buffered: int = 32
    max_connections_per_source: int = 4096
    max_connections_per_lease: int = 2048
    policy: tuple[PolicyLayer, ...] = ()
    policy_mode: PolicyMode = PolicyMode.ENFORCE
    policy_file: str | None = None
    policy_layers: tuple[PolicyLayer, ...] = ()
    await_policy: float = 0.0

    def __post_init__(self) -> None:
        if self.admin_token and self.admin_token_hash:
            raise SettingError("--admin-token-hash", "goes instead of --admin-token, not with it")
        try:
            check_bounds((*self.policy, *self.policy_layers))
        except ValueError as error:
            raise SettingError("--policy", str(error)) from None
        self._check_versions()
        taken: dict[int, str] = {}
        for option, port in (
            ("--master-port", self.master_port),
            ("--publish-master", self.publish_master),
            ("--admin-bind", self.admin.port),
        ):
            if port is None:
                continue
            if port in self.ports.listen:
                text = f"port {port} lies in --port-range {self.ports.listen}; move one of them"
                raise SettingError(option, text)
            if port in taken:
                text = f"port {port} is that of {taken[port]}; move one of them"
                raise SettingError(option, text)
            taken[port] = option

    def _check_versions(self) -> None:
        if self.for_ros1 and not self.master_uri:
            text = "missing; give the real ROS master, e.g. http://robot:11311 (ROS_MASTER_URI)"
            raise SettingError("--master-uri", text)
        count = len(self.domains)
        if self.for_ros2 and len(self.ports.listen) < LEAST_PER_DOMAIN * count:
            text = f"{self.ports.listen} is too short: each of {count} domains needs"
            raise SettingError("--port-range", f"{text} {LEAST_PER_DOMAIN} ports")
        if self.for_ros2 and count > 1:
            self._check_domains_stay_apart()

    def _check_domains_stay_apart(self) -> None:
        """An announcement need not tell its domain: what has one port has one domain."""
        cure = "start a proxy for each domain"
        if self.ros2_ear:
            raise SettingError("--ros2-ear", f"an ear is for one domain: {cure}")
        for peer in self.ros2_peer:
            if peer.port:
                text = f"{peer} is one domain of another proxy: {cure}"
                raise SettingError("--ros2-peer", text)

    @property
    def for_ros1(self) -> bool:
        """Whether it is for ROS 1."""
        return "1" in self.ros

    @property
    def for_ros2(self) -> bool:
        """Whether it is for ROS 2."""
        return "2" in self.ros

    @property
    def domains(self) -> tuple[int, ...]:
        """The domains of ROS 2."""
        return tuple(dict.fromkeys(self.ros2_domain)) or (0,)

    @property
    def token_hash(self) -> str | None:
        """The hash of what callers that are not on loopback must know; None: they may do nothing.

        It is that of the token where that was given: the admin endpoint holds a hash in any case.
        """
        return hash_token(self.admin_token) if self.admin_token else self.admin_token_hash


def hash_token(token: str) -> str:
    """The SHA-256 of a token, in 64 hex digits, as ``--admin-token-hash`` takes it."""
    return hashlib.sha256(token.encode()).hexdigest()


def make_settings(
    port_range: PortRange,
    advertise_port_range: PortRange | None,
    admin_bind: HostPort,
    inside_network: tuple[Network, ...],
    policy: tuple[tuple[Rule, ...], ...] = (),
    policy_mode: str = PolicyMode.ENFORCE.value,
    **others: Any,
) -> Settings:
    """Settings from the values of the command line's options, by their names.

    Raises SettingError if they don't go together.
    """
    advertise = advertise_port_range or port_range
    if len(advertise) != len(port_range):
        raise SettingError(
            "--advertise-port-range",
            f"{advertise} has {len(advertise)} ports and --port-range {port_range} has "
            f"{len(port_range)}; both need the same number",
        )
    ports = PortMap(port_range, advertise)
    others["master_uri"] = others.get("master_uri") or ""  # ROS 2 has none
    mode, rules = PolicyMode(policy_mode), tuple(rule for given in policy for rule in given)
    return Settings(
        ports=ports,
        admin=admin_bind,
        inside_networks=inside_network,
        policy=(PolicyLayer("--policy", rules, mode),) if rules else (),
        policy_mode=mode,
        **others,
    )


def read_range(text: str) -> PortRange:
    """A range of ports, ``first-last``. Raises ValueError."""
    found = _RANGE.fullmatch(text)
    if found is None:
        raise ValueError(f"{text[:_LONGEST]!r} is not a range such as 11000-11099")
    ports = PortRange(int(found[1]), int(found[2]))
    if not 1 <= ports.first <= ports.last <= 65535:
        raise ValueError(f"{text!r} must rise and lie between 1 and 65535, such as 11000-11099")
    return ports


def read_host(text: str) -> str:
    """A host name or address, which comes out without brackets. Raises ValueError."""
    bare = text.strip("[]")
    if parse_host_port(f"[{bare}]:1" if ":" in bare else f"{bare}:1") != HostPort(bare, 1):
        raise ValueError(
            f"{text[:_LONGEST]!r} is neither a host name nor an address such as 192.0.2.7"
        )
    return bare


def read_address(text: str) -> str | None:
    """An IP address in its plain form; None for no text. Raises ValueError."""
    address = addresses.parse_address(text)
    if text and address is None:
        raise ValueError(f"{text[:_LONGEST]!r} is not an IP address such as 192.0.2.7")
    return address


def read_bind_address(text: str) -> str:
    """An IP address to listen on, also the unspecified one. Raises ValueError."""
    try:
        return str(ip_address(text))
    except ValueError:
        message = f"{text[:_LONGEST]!r} is not an IP address of this host, such as 0.0.0.0"
        raise ValueError(message) from None


def read_host_port(text: str) -> HostPort:
    """``host:port`` or ``[v6]:port``. Raises ValueError."""
    where = parse_host_port(text)
    if where is None:
        raise ValueError(f"{text[:_LONGEST]!r} is not of the form {DEFAULT_ADMIN}")
    return where


def read_peer(text: str) -> HostPort:
    """A peer of ROS 2: a host, or ``host:port``; without a port it is 0. Raises ValueError."""
    try:
        return HostPort(read_host(text), 0)
    except ValueError:
        return read_host_port(text)


def read_network(text: str) -> Network:
    """A network as CIDR. Raises ValueError."""
    try:
        return ip_network(text)
    except ValueError as error:
        message = f"{text[:_LONGEST]!r} is not a network such as 172.18.0.0/16: {error}"
        raise ValueError(message) from None


def read_master_uri(text: str) -> str:
    """The URI of a ROS master. Raises ValueError."""
    if not text.startswith("http://") or addresses.parse_authority(text) is None:
        raise ValueError(f"{text[:_LONGEST]!r} is not of the form http://host:11311")
    return text


def read_token(text: str) -> str | None:
    """What travels in a header: printable ASCII without spaces; None for no text.

    Raises ValueError, which does not repeat it.
    """
    if text and not _TOKEN.fullmatch(text):
        raise ValueError(
            "must be 8 to 200 letters, digits or signs without spaces, for example the output of "
            "openssl rand -hex 16"
        )
    return text or None


def read_token_hash(text: str) -> str | None:
    """A SHA-256 in hex digits, in lower case; None for no text. Raises ValueError."""
    digits = text.strip().lower()
    if digits and not _HASH.fullmatch(digits):
        raise ValueError(
            'must be the 64 hex digits of a SHA-256: printf %s "$TOKEN" | sha256sum gives them'
        )
    return digits or None


def read_policy_layers(text: str) -> tuple[PolicyLayer, ...]:
    """The layers of a policy as JSON; none for no text. Raises ValueError."""
    try:
        return read_layers(json.loads(text)) if text.strip() else ()
    except RecursionError:
        raise ValueError("nested too deeply") from None


def parse_range(option: str, text: str) -> PortRange:
    """Like `read_range`. Raises SettingError that names ``option``."""
    return _named(option, read_range, text)


def parse_host(option: str, text: str) -> str:
    """Like `read_host`. Raises SettingError that names ``option``."""
    return _named(option, read_host, text)


def _named(option: str, read: Callable[[str], _Value], text: str) -> _Value:
    try:
        return read(text)
    except ValueError as error:
        raise SettingError(option, str(error)) from None
