"""Export (inside to outside) and import (outside to inside) of URIs.

Export and import are inverses for every URI that the proxy has ever given out. A tool inside may
send back any such URI: ``rosnode cleanup`` does this when it unregisters a node of another process.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import msgspec

from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.registry.registry import Registry
from rosproxy.ros1.registry.stand_ins import StandIns
from rosproxy.shared.addresses import HostPort, Network, is_inside
from rosproxy.shared.ports import PortMap
from rosproxy.shared.uris import (
    parse_inside_path,
    parse_service_uri,
    parse_slave_uri,
    service_uri,
    slave_uri,
    with_caller_address,
)


class Caller(msgspec.Struct, frozen=True):
    """The node that is going to use an address.

    ``address`` is the caller's own IP address, ``proxy`` the proxy's address that the caller
    reaches, ``caller_id`` the node name and ``endpoint`` the endpoint of the caller, each as far as
    known. ``master`` is the address by which the caller calls its master: ``host:port``.
    """

    address: str
    proxy: str
    caller_id: str = ""
    master: str = ""
    endpoint: Endpoint | None = None


@dataclass(slots=True)
class Addressing:
    """The rules that export and import addresses.

    ``host`` is the advertised host. Nodes within one of ``networks`` reach each other without the
    proxy.
    """

    registry: Registry
    host: str
    ports: PortMap
    stand_ins: StandIns
    networks: Sequence[Network] = field(default_factory=tuple)
    _advertised: dict[int, str] = field(default_factory=dict)

    def outside(self, port: int) -> HostPort:
        """The host and port at which outside reaches a listening port of the proxy."""
        return HostPort(self.host, self.ports.advertised(port))

    def advertised_uri(self, endpoint: Endpoint) -> str:
        """The slave URI that the master and outside have for an endpoint.

        The URI has no path: some client libraries call a URI with a path malformed, or take the
        path for a part of the port.
        """
        uri = self._advertised.get(endpoint.port)
        if uri is None:
            uri = self._advertised[endpoint.port] = slave_uri(self.outside(endpoint.port))
        return uri

    def uris_at_master(self, endpoint: Endpoint) -> list[str]:
        """The slave URIs that the master may have for an endpoint, from former versions as well."""
        former = [uri for uri in endpoint.former_uris if self.lease_of(uri) == endpoint.port]
        return list(dict.fromkeys([self.advertised_uri(endpoint), *former]))

    def advertised_service(self, endpoint: Endpoint) -> str:
        """The service URI that outside has for the services of an endpoint."""
        return service_uri(self.outside(endpoint.port))

    def export_slave(self, uri: str, caller: Caller) -> str:
        """The outside form of a slave URI that an inside node gave; others stay the same."""
        uri = with_caller_address(uri, caller.address)
        if (original := self.stand_ins.export_uri(uri)) is not None:
            return original
        slave = parse_slave_uri(uri)
        endpoint = self._meant_by(slave, caller) if slave else None
        if endpoint:
            return self.advertised_uri(endpoint)
        if slave and self._is_inside_form(slave, caller):
            return uri.replace(str(slave), str(self.outside(slave.port)), 1)
        return uri

    def export_service(self, uri: str, service: str, caller: Caller) -> str:
        """The outside form of the URI of a service that an inside node gave."""
        uri = with_caller_address(uri, caller.address)
        if (original := self.stand_ins.export_uri(uri)) is not None:
            return original
        host_port = parse_service_uri(uri)
        if host_port is None:
            return uri
        if self._is_inside_form(host_port, caller):
            return service_uri(self.outside(host_port.port))
        provider = self.registry.services.get(service)
        if provider and (host_port.host == provider[0].node.host or uri == provider[1].service_api):
            return self.advertised_service(provider[0])
        return uri

    def import_slave(self, uri: str, caller: Caller) -> str:
        """The form of a slave URI from outside that an inside node can use."""
        endpoint = self.endpoint_of(uri)
        return self._import(endpoint, caller) if endpoint else self._import_foreign(uri, caller)

    def import_service(self, uri: str, service: str, caller: Caller) -> str:
        """The form of a service URI from outside that an inside node can use."""
        endpoint = self._endpoint_at(parse_service_uri(uri))
        if endpoint is None:
            return self._import_foreign(uri, caller)
        own_uri = self._own_service_uri(endpoint, service)
        if own_uri and self._is_direct(endpoint, caller):
            return own_uri
        return service_uri(HostPort(caller.proxy, endpoint.port))

    def stand_in_target(self, uri: str) -> HostPort | None:
        """The host and port for a stand-in for a URI at the master; None if none is needed."""
        target = self.stand_ins.target(uri)
        if target is None or self.advertises(target) or is_inside(target.host, self.networks):
            return None
        return target

    def is_own_uri(self, uri: str, caller: Caller) -> bool:
        """Whether a slave URI is a URI of this proxy, in the inside or the outside form."""
        slave = parse_slave_uri(uri)
        if slave is None:
            return False
        return self._is_inside_form(slave, caller) or self.endpoint_of(uri) is not None

    def advertises(self, host_port: HostPort) -> bool:
        """Whether outside reaches a port of this proxy at a host and port."""
        return self._listening(host_port) is not None

    def lease_of(self, uri: str) -> int | None:
        """The listening port of an advertised slave URI of this proxy; None for any other URI."""
        return self._listening(parse_slave_uri(uri))

    def _import_foreign(self, uri: str, caller: Caller) -> str:
        """The URI of the stand-in for a URI of outside; the URI itself without a stand-in."""
        stand_in = self.stand_ins.find(self.stand_ins.address(caller.proxy), uri)
        return stand_in.inside_uri if stand_in and self.stand_in_target(uri) else uri

    def _import(self, endpoint: Endpoint, caller: Caller) -> str:
        # Several nodes may give the same URI. When the URI comes back, it has to mean this node.
        if self._is_direct(endpoint, caller) and self._meant_by(endpoint.node, caller) is endpoint:
            return endpoint.uri
        return slave_uri(HostPort(caller.proxy, endpoint.port))

    def _is_direct(self, endpoint: Endpoint, caller: Caller) -> bool:
        # A node gets its own URI unchanged: roscpp compares the text, so that the node does not
        # connect to itself (subscription.cpp, pubUpdate).
        if endpoint is caller.endpoint:
            return True
        if caller.address == endpoint.location.address:
            return not endpoint.location.stale
        shared = [n for n in self.networks if is_inside(caller.address, [n])]
        return endpoint.location.named and is_inside(endpoint.location.address, shared)

    def endpoint_of(self, uri: str) -> Endpoint | None:
        """The endpoint of an advertised slave URI; None if there is none.

        A URI of a former version has the inside address in its path. If this address differs from
        the endpoint's, the URI means a node that had the port before.
        """
        endpoint = self._endpoint_at(parse_slave_uri(uri))
        if endpoint is None:
            return None
        inside = parse_inside_path(uri)
        return endpoint if inside is None or inside.slave == endpoint.slave else None

    def _endpoint_at(self, host_port: HostPort | None) -> Endpoint | None:
        port = self._listening(host_port)
        return self.registry.by_port.get(port) if port else None

    def _listening(self, host_port: HostPort | None) -> int | None:
        if host_port is None or host_port.host != self.host:
            return None
        return self.ports.listening(host_port.port)

    def _is_inside_form(self, host_port: HostPort, caller: Caller) -> bool:
        """Whether a host and port are a port of the range, at the address that the caller uses."""
        return host_port.host == caller.proxy and host_port.port in self.ports.listen

    def _meant_by(self, node: HostPort, caller: Caller) -> Endpoint | None:
        """The endpoint that a caller means by a host and port: several nodes may give the same."""
        admitted = self.registry.admitted(node, caller.address)

        def distance(endpoint: Endpoint) -> tuple[bool, bool, bool]:
            own = endpoint is caller.endpoint
            return not own, endpoint is not admitted, endpoint.location.address != caller.address

        return min(self.registry.by_node(node), key=distance, default=None)

    def _own_service_uri(self, endpoint: Endpoint, service: str) -> str | None:
        """The URI of a service as its node gave it; None if unknown (after a recovery)."""
        provider = self.registry.services.get(service)
        return provider[1].service_api if provider and provider[0] is endpoint else None
