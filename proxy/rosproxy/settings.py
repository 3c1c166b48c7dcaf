"""The settings of a proxy, validated."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from ipaddress import ip_address, ip_network
from typing import Any, Literal

from rosproxy.leases.ports import PortMap, PortRange
from rosproxy.net.addresses import (
    HostPort,
    Network,
    parse_address,
    parse_authority,
    parse_host_port,
)

DEFAULT_ADMIN = HostPort("127.0.0.1", 11312)
DataPlane = Literal["auto", "kernel", "splice", "copy"]
"""How topics' bytes are forwarded: by the kernel, spliced, or copied; auto: the best possible."""


class SettingError(ValueError):
    """A setting that can't be used. ``option`` names it as on the command line."""

    def __init__(self, option: str, problem: str) -> None:
        super().__init__(f"{option}: {problem}")
        self.option = option


@dataclass(frozen=True, slots=True)
class Settings:
    """Everything that ``rosproxy run`` can be told. Times are in seconds.

    ``inside_networks`` empty means: the networks of the proxy's own interfaces.
    ``master_address``: the IP address of the master's host where the proxy can't resolve its name
    or would find itself. ``admin_token``: what callers that are not on loopback must know.
    """

    master_uri: str
    advertise_host: str
    ports: PortMap
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
    slave_control: Literal["any", "master"] = "any"
    data_plane: DataPlane = "auto"
    master_address: str | None = None
    admin_token: str | None = field(default=None, repr=False)


def parse_settings(options: Mapping[str, Any]) -> Settings:
    """Settings from the values of the command line's options.

    Raises SettingError for the first value that can't be used.
    """
    listen = parse_range("--port-range", options["port_range"])
    text = options.get("advertise_port_range")
    advertise = parse_range("--advertise-port-range", text) if text else listen
    if len(advertise) != len(listen):
        raise SettingError(
            "--advertise-port-range",
            f"{advertise} has {len(advertise)} ports and --port-range {listen} has {len(listen)}; "
            "both need the same number",
        )
    settings = Settings(
        master_uri=_master_uri(options.get("master_uri")),
        advertise_host=_advertise_host(options.get("advertise_host")),
        ports=PortMap(listen, advertise),
        master_port=_port("--master-port", options["master_port"]),
        publish_master=_optional_port("--publish-master", options.get("publish_master")),
        bind=_bind(options["bind"]),
        admin=parse_admin(options["admin_bind"], DEFAULT_ADMIN),
        inside_networks=tuple(_network(text) for text in options.get("inside_network") or ()),
        slave_control=options["slave_control"],
        data_plane=options.get("data_plane") or "auto",
        master_address=_master_address(options.get("master_address")),
        admin_token=_admin_token(options.get("admin_token")),
        **{name: _seconds(name, options[name]) for name in _TIMES},
    )
    _check_overlaps(settings)
    return settings


_RANGE = re.compile(r"\s*([0-9]{1,5})\s*-\s*([0-9]{1,5})\s*")
_TOKEN = re.compile(r"[!-~]{8,200}")
_TIMES = ("probe_interval", "probe_timeout", "cleanup_after", "linger", "master_interval")
_MAY_BE_ZERO = ("cleanup_after", "linger")


def parse_range(option: str, text: str) -> PortRange:
    """Parse ``first-last``. Raises SettingError that names ``option``."""
    found = _RANGE.fullmatch(text)
    if found is None:
        raise SettingError(option, f"{text[:40]!r} is not a range such as 45000-45099")
    ports = PortRange(int(found[1]), int(found[2]))
    if not 1 <= ports.first <= ports.last <= 65535:
        raise SettingError(option, f"{text!r} must rise and lie between 1 and 65535")
    return ports


def _master_uri(uri: str | None) -> str:
    if not uri:
        raise SettingError(
            "--master-uri",
            "missing; give the real master, e.g. http://robot:11311 (ROS_MASTER_URI)",
        )
    if not uri.startswith("http://") or parse_authority(uri) is None:
        raise SettingError("--master-uri", f"{uri!r} is not of the form http://host:11311")
    return uri


def _master_address(text: str | None) -> str | None:
    if not text:
        return None
    address = parse_address(text)
    if address is None:
        raise SettingError(
            "--master-address", f"{text[:40]!r} is not an IP address such as 192.0.2.7"
        )
    return address


def _admin_token(text: str | None) -> str | None:
    """It travels in a header: printable ASCII without spaces."""
    if not text:
        return None
    if not _TOKEN.fullmatch(text):
        raise SettingError(
            "--admin-token",
            "must be 8 to 200 letters, digits or signs without spaces, for example the output of "
            "openssl rand -hex 16",
        )
    return text


def _advertise_host(host: str | None) -> str:
    if not host:
        raise SettingError(
            "--advertise-host",
            "missing; give the name or address under which outside nodes reach this host "
            "(ROSPROXY_ADVERTISE_HOST)",
        )
    return parse_host("--advertise-host", host)


def parse_host(option: str, text: str) -> str:
    """Parse a host name or address, without brackets. Raises SettingError that names ``option``."""
    bare = text.strip("[]")
    if parse_host_port(f"[{bare}]:1" if ":" in bare else f"{bare}:1") != HostPort(bare, 1):
        raise SettingError(option, f"{text!r} is neither a host name nor an address")
    return bare


def _port(option: str, port: int) -> int:
    if not 1 <= port <= 65535:
        raise SettingError(option, f"{port} is not a port between 1 and 65535")
    return port


def _optional_port(option: str, port: int | None) -> int | None:
    return None if port is None else _port(option, port)


def _bind(address: str) -> str:
    try:
        return str(ip_address(address))
    except ValueError:
        raise SettingError("--bind", f"{address!r} is not an IP address of this host") from None


def parse_admin(text: str, default: HostPort) -> HostPort:
    """Parse ``--admin-bind``; ``default`` serves as the example. Raises SettingError."""
    where = parse_host_port(text)
    if where is None:
        raise SettingError("--admin-bind", f"{text!r} is not of the form {default}")
    return where


def _network(text: str) -> Network:
    try:
        return ip_network(text)
    except ValueError as error:
        raise SettingError("--inside-network", f"{text!r} is not a network: {error}") from None


def _seconds(name: str, value: float) -> float:
    low = 0.0 if name in _MAY_BE_ZERO else 0.05
    return parse_seconds("--" + name.replace("_", "-"), value, low)


def parse_seconds(option: str, value: float, low: float) -> float:
    """Check a time between ``low`` and a day. Raises SettingError that names ``option``."""
    if not low <= value <= 86400:
        raise SettingError(option, f"{value:g} s is not between {low:g} and 86400 s")
    return float(value)


def _check_overlaps(settings: Settings) -> None:
    taken: dict[int | None, str] = {}
    for option, port in (
        ("--master-port", settings.master_port),
        ("--publish-master", settings.publish_master),
        ("--admin-bind", settings.admin.port),
    ):
        if port in settings.ports.listen:
            raise SettingError(
                option,
                f"port {port} lies in --port-range {settings.ports.listen}; move one of them",
            )
        if port in taken:
            raise SettingError(option, f"port {port} is that of {taken[port]}; move one of them")
        taken[port] = option
