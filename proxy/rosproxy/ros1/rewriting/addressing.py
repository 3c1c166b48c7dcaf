"""Export (inside to outside) and import (outside to inside) of URIs.

The two are inverses for every URI that the proxy ever handed out: a tool inside may send any of
them back, as ``rosnode cleanup`` does when it unregisters somebody else's node.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import msgspec

from rosproxy.leases.ports import PortMap
from rosproxy.net.addresses import HostPort, Network, is_inside
from rosproxy.ros1.protocol.uris import (
    parse_inside_path,
    parse_service_uri,
    parse_slave_uri,
    placed,
    service_uri,
    slave_uri,
)
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.registry.registry import Registry
from rosproxy.ros1.registry.stand_ins import StandIns


class Caller(msgspec.Struct, frozen=True):
    """Who is going to use an address.

    ``address`` is the caller's own IP address, ``proxy`` the proxy's address that it can reach,
    ``caller_id`` its node name and ``endpoint`` its endpoint, each as far as known. ``master`` is
    how it calls its master: ``host:port``.
    """

    address: str
    proxy: str
    caller_id: str = ""
    master: str = ""
    endpoint: Endpoint | None = None


@dataclass(slots=True)
class Addressing:
    """The rules that turn one side's addresses into the other's.

    ``networks`` are those inside which nodes reach each other without the proxy.
    """

    registry: Registry
    host: str
    ports: PortMap
    stand_ins: StandIns
    networks: Sequence[Network] = field(default_factory=tuple)
    _advertised: dict[int, str] = field(default_factory=dict)

    def outside(self, port: int) -> HostPort:
        """What outside sees of a port that the proxy listens on."""
        return HostPort(self.host, self.ports.advertised(port))

    def advertised_uri(self, endpoint: Endpoint) -> str:
        """The slave URI that stands for an endpoint at the master and outside.

        It has no path: some client libraries take that for a malformed URI, or for a port.
        """
        uri = self._advertised.get(endpoint.port)
        if uri is None:
            uri = self._advertised[endpoint.port] = slave_uri(self.outside(endpoint.port))
        return uri

    def uris_at_master(self, endpoint: Endpoint) -> list[str]:
        """The slave URIs by which the master may have an endpoint: a former version's, too."""
        former = [uri for uri in endpoint.former_uris if self.lease_of(uri) == endpoint.port]
        return list(dict.fromkeys([self.advertised_uri(endpoint), *former]))

    def advertised_service(self, endpoint: Endpoint) -> str:
        """The service URI that stands for an endpoint's services outside."""
        return service_uri(self.outside(endpoint.port))

    def export_slave(self, uri: str, caller: Caller) -> str:
        """The outside form of a slave URI that an inside node gave."""
        uri = placed(uri, caller.address)
        if (original := self.stand_ins.export_uri(uri)) is not None:
            return original
        where = parse_slave_uri(uri)
        endpoint = self._own(where, caller) if where else None
        if endpoint:
            return self.advertised_uri(endpoint)
        if where and self._is_relayed(where, caller):
            return uri.replace(str(where), str(self.outside(where.port)), 1)
        return uri

    def export_service(self, uri: str, service: str, caller: Caller) -> str:
        """The outside form of the URI of a service that an inside node gave."""
        uri = placed(uri, caller.address)
        if (original := self.stand_ins.export_uri(uri)) is not None:
            return original
        where = parse_service_uri(uri)
        if where is None:
            return uri
        if self._is_relayed(where, caller):
            return service_uri(self.outside(where.port))
        known = self.registry.services.get(service)
        if known and (where.host == known[0].node.host or uri == known[1].service_api):
            return self.advertised_service(known[0])
        return uri

    def import_slave(self, uri: str, caller: Caller) -> str:
        """The form of a slave URI from outside that an inside node can use."""
        endpoint = self.stands_for(uri)
        return self._import(endpoint, caller) if endpoint else self._import_foreign(uri, caller)

    def import_service(self, uri: str, service: str, caller: Caller) -> str:
        """The form of a service URI from outside that an inside node can use."""
        endpoint = self._endpoint_at(parse_service_uri(uri))
        if endpoint is None:
            return self._import_foreign(uri, caller)
        literal = self._service_literal(endpoint, service)
        if literal and self._direct(endpoint, caller):
            return literal
        return service_uri(HostPort(caller.proxy, endpoint.port))

    def foreign(self, uri: str) -> HostPort | None:
        """What a stand-in for a URI that the master has needs to lead to; None if it needs none."""
        where = self.stand_ins.target(uri)
        if where is None or self.advertises(where) or is_inside(where.host, self.networks):
            return None
        return where

    def handed_out(self, uri: str, caller: Caller) -> bool:
        """Whether a slave URI is one of this proxy's own, in the inside or the outside form."""
        where = parse_slave_uri(uri)
        if where is None:
            return False
        return self._is_relayed(where, caller) or self.stands_for(uri) is not None

    def advertises(self, where: HostPort) -> bool:
        """Whether outside finds one of this proxy's own ports at a host and port."""
        return self._listening(where) is not None

    def lease_of(self, uri: str) -> int | None:
        """The listening port of an advertised slave URI of this proxy."""
        return self._listening(parse_slave_uri(uri))

    def _import_foreign(self, uri: str, caller: Caller) -> str:
        return self.stand_ins.import_uri(uri, caller.proxy) if self.foreign(uri) else uri

    def _import(self, endpoint: Endpoint, caller: Caller) -> str:
        if self._direct(endpoint, caller) and self._own(endpoint.node, caller) is endpoint:
            return endpoint.uri
        return slave_uri(HostPort(caller.proxy, endpoint.port))

    def _direct(self, endpoint: Endpoint, caller: Caller) -> bool:
        if endpoint is caller.endpoint:
            return True
        if caller.address == endpoint.location.address:
            return not endpoint.location.stale
        shared = [n for n in self.networks if is_inside(caller.address, [n])]
        return endpoint.location.named and is_inside(endpoint.location.address, shared)

    def stands_for(self, uri: str) -> Endpoint | None:
        """The endpoint that an advertised slave URI stands for.

        Those of former versions carry the inside address in their path: another one means another
        node, which had the port before.
        """
        endpoint = self._endpoint_at(parse_slave_uri(uri))
        inside = parse_inside_path(uri)
        if endpoint is None or inside is None or inside.slave == endpoint.slave:
            return endpoint
        return None

    def _endpoint_at(self, where: HostPort | None) -> Endpoint | None:
        port = self._listening(where)
        return self.registry.by_port.get(port) if port else None

    def _listening(self, where: HostPort | None) -> int | None:
        if where is None or where.host != self.host:
            return None
        return self.ports.listening(where.port)

    def _is_relayed(self, where: HostPort, caller: Caller) -> bool:
        return where.host == caller.proxy and where.port in self.ports.listen

    def _own(self, node: HostPort, caller: Caller) -> Endpoint | None:
        """Whom an caller means by a host and port; several nodes may call themselves the same."""
        admitted = self.registry.admitted(node, caller.address)

        def distance(endpoint: Endpoint) -> tuple[bool, bool, bool]:
            itself = endpoint is caller.endpoint
            return not itself, endpoint is not admitted, endpoint.location.address != caller.address

        return min(self.registry.by_node(node), key=distance, default=None)

    def _service_literal(self, endpoint: Endpoint, service: str) -> str | None:
        """A service as its provider gave it; None if that is not known (after a recovery)."""
        known = self.registry.services.get(service)
        return known[1].service_api if known and known[0] is endpoint else None
