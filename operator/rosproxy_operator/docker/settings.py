"""The settings of ``rosproxy-operator docker``, validated."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from ipaddress import ip_address
from typing import Any

from rosproxy.net.addresses import HostPort, is_loopback
from rosproxy.ros1.protocol.uris import parse_slave_uri
from rosproxy.settings import SettingError, parse_admin, parse_host, parse_range, parse_seconds
from rosproxy_operator.common.settings import parse_image
from rosproxy_operator.docker.planner.model import MOST_PORTS, PlanSettings

DEFAULT_ADMIN = HostPort("127.0.0.1", 11313)
_NETWORK = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")


@dataclass(frozen=True, slots=True)
class DockerSettings:
    """Everything that ``rosproxy-operator docker`` can be told.

    ``resync`` is in seconds: how long it waits at most between two looks. ``admin`` is where it
    serves its own health.
    """

    plan: PlanSettings
    resync: float = 30.0
    admin: HostPort = DEFAULT_ADMIN


def parse_docker_settings(options: Mapping[str, Any]) -> DockerSettings:
    """Settings from the values of the command line's options.

    Raises SettingError for the first value that can't be used.
    """
    host = options.get("advertise_host")
    plan = PlanSettings(
        master_uri=_master(options.get("master_uri") or ""),
        advertise_host=parse_host("--advertise-host", host) if host else "",
        ports=_ports(options["ports"]),
        window=parse_range("--port-window", options["port_window"]),
        publish=tuple(map(_publish, options["publish_address"] or ("0.0.0.0",))),
        image=parse_image(options["proxy_image"]),
        expose_by_default=options["expose_by_default"],
        grace=parse_seconds("--grace", options["grace"], 0.0),
        uplink=_uplink(options["uplink"]),
        data_plane=options.get("data_plane") or "auto",
    )
    if len(plan.window) < plan.ports:
        raise SettingError(
            "--port-window", f"{plan.window} has {len(plan.window)} ports, --ports is {plan.ports}"
        )
    return DockerSettings(
        plan=plan,
        resync=parse_seconds("--resync", options["resync"], 1.0),
        admin=parse_admin(options["admin_bind"], DEFAULT_ADMIN),
    )


def _master(uri: str) -> str:
    where = parse_slave_uri(uri)
    if uri and where is None:
        raise SettingError("--master-uri", f"{uri!r} is not of the form http://host:11311")
    if where and is_loopback(where.host):
        raise SettingError(
            "--master-uri",
            f"{uri!r} means another machine to each container; give the address or name of the "
            "master's host, or http://host.docker.internal:PORT for this one",
        )
    return uri


def _ports(count: int) -> int:
    if not 1 <= count <= MOST_PORTS:
        raise SettingError("--ports", f"{count} is not between 1 and {MOST_PORTS}")
    return count


def _publish(text: str) -> str:
    try:
        return str(ip_address(text))
    except ValueError:
        raise SettingError("--publish-address", f"{text!r} is not an IP address") from None


def _uplink(text: str) -> str:
    if not _NETWORK.fullmatch(text):
        raise SettingError("--uplink", f"{text!r} is not a network's name")
    return text
