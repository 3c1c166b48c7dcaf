"""The parameter at the master that outlasts the proxy: where the node of each lease is.

A slave URI at the master only tells the port of the lease (``http://HOST:PORT/``). Some client
libraries cannot read a URI with a path: roslisp calls such a URI malformed, and ROS.NET takes all
that follows the colon for the port. So the proxy keeps the rest at the parameter server, as
roslaunch does with data that outlast roslaunch. The value is a text with a line for each lease: the
advertised port, the node's own address in the form of `rosproxy.shared.uris.inside_path`,
and the TCPROS ports of services, which nodes do not tell:

    50000 /172.30.0.11:38191/ 41234
    50001 /c2:40001/172.30.0.12/

The name of the parameter has the advertised host and the first port of the range, so each proxy has
its own parameter. Any program can write to the parameter. So the content is a claim, like all data
from the master, and the nodes have to confirm it (`rosproxy.ros1.upkeep.verifier`).
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from itertools import islice

import msgspec

from rosproxy.ros1.registry.endpoint import MOST_SERVICE_PORTS, Endpoint
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortMap
from rosproxy.shared.uris import InsidePath, inside_path, parse_inside_path

_NOT_IN_NAMES = re.compile(r"[^A-Za-z0-9]")
_LINE = re.compile(r"(\d{1,5}) (/\S{1,4096}/)((?: \d{1,5})*)")


class RememberedLease(msgspec.Struct, frozen=True):
    """The location of the node of a lease, and the TCPROS ports of its services."""

    node: InsidePath
    service_ports: tuple[int, ...] = ()


NAMESPACE = "/rosproxy"
"""The namespace of the parameters of all proxies."""
MOST_LINES = 65_536
"""Lines that are read for an advertised host: as many as a host has ports."""


def parameter_of(host: str, ports: PortMap) -> str:
    """The name of the parameter of the proxy with an advertised host and range."""
    return f"{NAMESPACE}/{_name_of(host)}{ports.advertise.first}"


def leases_text(endpoints: Iterable[Endpoint], ports: PortMap) -> str:
    """The value of the parameter; "" if there is nothing to remember."""
    return "".join(f"{_line(endpoint, ports)}\n" for endpoint in endpoints)


def read_leases(value: object, ports: PortMap) -> Mapping[int, RememberedLease]:
    """Read the leases of the range from a value, by listening port; bad lines are left out."""
    lines = value.splitlines() if isinstance(value, str) else ()
    leases = {ports.listening(port): lease for port, lease in _read(lines)}
    return {port: lease for port, lease in leases.items() if port is not None}


class LeasesAtMaster:
    """The leases of all proxies at the master. ``parameters`` is the value of NAMESPACE there.

    Any program can write to the parameters, and may make them long. So each line is read once, up
    to MOST_LINES for an advertised host.
    """

    def __init__(self, parameters: object) -> None:
        self._values: dict[str, list[str]] = {}
        """The values by the name of the parameter, without the port at its end."""
        for key, value in parameters.items() if isinstance(parameters, dict) else ():
            if isinstance(value, str):
                self._values.setdefault(str(key).rstrip("0123456789"), []).append(value)
        self._by_host: dict[str, dict[int, RememberedLease]] = {}

    def at(self, advertised: HostPort) -> RememberedLease | None:
        """The lease at an advertised host and port; None if no parameter has this lease."""
        name = _name_of(advertised.host)
        if name not in self._by_host:
            self._by_host[name] = self._read(name)
        return self._by_host[name].get(advertised.port)

    def _read(self, name: str) -> dict[int, RememberedLease]:
        lines = (line for value in self._values.get(name, ()) for line in value.splitlines())
        leases: dict[int, RememberedLease] = {}
        for port, lease in _read(islice(lines, MOST_LINES)):
            leases.setdefault(port, lease)
        return leases


def _name_of(host: str) -> str:
    return f"leases_{_NOT_IN_NAMES.sub('_', host)}_"


def _read(lines: Iterable[str]) -> Iterator[tuple[int, RememberedLease]]:
    """The advertised ports in the lines of values, each with its lease."""
    for line in lines:
        match = _LINE.fullmatch(line)
        # Only the path counts. Host and port of the URI may be any.
        node = parse_inside_path(f"http://h:1{match[2]}") if match else None
        if match and node:
            services = [int(text) for text in match[3].split()][:MOST_SERVICE_PORTS]
            yield int(match[1]), RememberedLease(node, tuple(p for p in services if 0 < p < 65536))


def _line(endpoint: Endpoint, ports: PortMap) -> str:
    path = inside_path(endpoint.inside_path)
    services = "".join(f" {port}" for port in endpoint.service_ports)
    return f"{ports.advertised(endpoint.port)} {path}{services}"
