"""What outlasts the proxy: where the node of each lease is, as one parameter at the master.

A slave URI at the master tells no more than the lease (``http://HOST:PORT/``): a path is too much
for some client libraries, which call such a URI malformed (roslisp) or take all that follows the
colon for the port (ROS.NET). So the rest is kept where roslaunch keeps what outlasts it, at the
parameter server: a text with a line for each lease, its advertised port, the node's own address in
the form of `rosproxy.ros1.protocol.uris.inside_path`, and the TCPROS ports of its services, which
no node can be asked for:

    50000 /172.30.0.11:38191/ 41234
    50001 /c2:40001/172.30.0.12/

It is named by the advertised host and the first port of the range, so that each proxy has one.
Anybody can write to it. So it is a claim, as is all that the master says, and the nodes are asked
(`rosproxy.ros1.upkeep.verifier`).
"""

import re
from collections.abc import Iterable, Iterator, Mapping

import msgspec

from rosproxy.leases.ports import PortMap
from rosproxy.net.addresses import HostPort
from rosproxy.ros1.protocol.uris import InsidePath, inside_path, parse_inside_path
from rosproxy.ros1.registry.endpoint import MOST_SERVICE_PORTS, Endpoint

_NO_NAME = re.compile(r"[^A-Za-z0-9]")
_LINE = re.compile(r"(\d{1,5}) (/\S{1,4096}/)((?: \d{1,5})*)")


class RememberedLease(msgspec.Struct, frozen=True):
    """Where the node of a lease was, and on which TCPROS ports it had services."""

    node: InsidePath
    service_ports: tuple[int, ...] = ()


NAMESPACE = "/rosproxy"
"""Where the parameters of all proxies are."""


def parameter_of(host: str, ports: PortMap) -> str:
    """The name of the parameter of the proxy with an advertised host and range."""
    return f"{NAMESPACE}/{_name_of(host)}{ports.advertise.first}"


def leases_text(endpoints: Iterable[Endpoint], ports: PortMap) -> str:
    """The parameter's value; empty if there is nothing to remember."""
    return "".join(f"{_line(endpoint, ports)}\n" for endpoint in endpoints)


def read_leases(value: object, ports: PortMap) -> Mapping[int, RememberedLease]:
    """What a value tells of the ports of the range, by the port that listens; never an error."""
    leases = {ports.listening(port): lease for port, lease in _read(value)}
    return {port: lease for port, lease in leases.items() if port is not None}


def lease_at(parameters: object, advertised: HostPort) -> RememberedLease | None:
    """What any proxy has at an advertised host and port, given the parameters in NAMESPACE."""
    name = _name_of(advertised.host)
    items = parameters.items() if isinstance(parameters, dict) else ()
    values = [v for key, v in items if str(key).startswith(name)]
    return next((lease for v in values for p, lease in _read(v) if p == advertised.port), None)


def _name_of(host: str) -> str:
    return f"leases_{_NO_NAME.sub('_', host)}_"


def _read(value: object) -> Iterator[tuple[int, RememberedLease]]:
    """The advertised ports in a value, with what it tells of each."""
    for line in value.splitlines() if isinstance(value, str) else ():
        match = _LINE.fullmatch(line)
        # Only the path counts; any host and port make a URI of it.
        node = parse_inside_path(f"http://h:1{match[2]}") if match else None
        if match and node:
            services = [int(text) for text in match[3].split()][:MOST_SERVICE_PORTS]
            yield int(match[1]), RememberedLease(node, tuple(p for p in services if 0 < p < 65536))


def _line(endpoint: Endpoint, ports: PortMap) -> str:
    path = inside_path(endpoint.inside_path)
    services = "".join(f" {port}" for port in endpoint.service_ports)
    return f"{ports.advertised(endpoint.port)} {path}{services}"
