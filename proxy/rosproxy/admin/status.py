"""The state of a running proxy as the document that ``/status`` serves."""

import os
import time

import msgspec

from rosproxy import __version__
from rosproxy.admin import status_document as document
from rosproxy.forwarding.kernel.plane import KernelPlane
from rosproxy.forwarding.relay import Relay
from rosproxy.leases import fast_ports
from rosproxy.ros1.alias.alias import Alias
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.servers.tcpros import TcprosServer
from rosproxy.ros1.upkeep.master_monitor import MasterMonitor


def describe(
    context: Context, monitor: MasterMonitor, tcpros: TcprosServer, alias: Alias, plane: KernelPlane
) -> document.ProxyStatus:
    """Everything that ``rosproxy status`` and ``rosproxy doctor`` show."""
    relays: dict[int, list[Relay]] = {}
    for relay in tcpros.relays:
        relays.setdefault(relay.port, []).append(relay)
    endpoints = sorted(context.registry, key=lambda endpoint: endpoint.port)
    return document.ProxyStatus(
        version=__version__,
        pid=os.getpid(),
        instance=context.instance,
        retired=context.retired,
        uptime=round(context.now() - context.metrics.started, 1),
        settings=_settings(context),
        master=_master(context, monitor),
        ports=_ports(context),
        data_plane=msgspec.convert(plane.status(), document.DataPlaneStatus),
        alias_ports=msgspec.convert(alias.status(), tuple[document.AliasPortStatus, ...]),
        nodes=tuple(_node(context, e, relays.get(e.port, []), plane) for e in endpoints),
        problems=tuple(
            document.ProblemStatus(round(max(time.time() - p.when, 0.0), 1), p.subject, p.text)
            for p in context.problems.all()
        ),
    )


def _settings(context: Context) -> document.StatusSettings:
    settings = context.settings
    return document.StatusSettings(
        master_port=settings.master_port,
        publish_master=settings.publish_master,
        advertise_host=settings.advertise_host,
        bind=settings.bind,
        inside_networks=tuple(map(str, context.addressing.networks)),
        cleanup_after=settings.cleanup_after,
        linger=settings.linger,
    )


def _master(context: Context, monitor: MasterMonitor) -> document.MasterStatus:
    return document.MasterStatus(
        uri=context.settings.master_uri,
        address=context.upstream.reached_at,
        pinned=context.upstream.master_address is not None,
        up=bool(monitor.up),
        error=monitor.error,
        pid=monitor.pid,
        since=round(context.now() - monitor.since, 1),
        round_trip=monitor.round_trip,
    )


def _ports(context: Context) -> document.PortsStatus:
    ports, pool = context.settings.ports, context.registry.pool
    return document.PortsStatus(
        listen=str(ports.listen),
        advertise=str(ports.advertise),
        used=len(context.registry),
        free=fast_ports.left(pool, context.registry),
        blocked=len(pool.blocked),
    )


def _node(
    context: Context, endpoint: Endpoint, relays: list[Relay], plane: KernelPlane
) -> document.EndpointStatus:
    return document.EndpointStatus(
        nodes=tuple(endpoint.caller_ids),
        uri=endpoint.uri,
        address=str(endpoint.slave),
        advertised_uri=context.addressing.advertised_uri(endpoint),
        port=endpoint.port,
        state=endpoint.state,
        publishes=tuple(endpoint.names(Kind.PUBLISHER)),
        subscribes=tuple(endpoint.names(Kind.SUBSCRIBER)),
        services=tuple(endpoint.names(Kind.SERVICE)),
        parameters=tuple(endpoint.names(Kind.PARAM)),
        connections=tuple(map(_connection, relays)),
        problems=tuple(problem.text for problem in context.problems.at(endpoint.port)),
        data_plane=msgspec.convert(plane.status_of(endpoint), document.NodePlaneStatus),
    )


def _connection(relay: Relay) -> document.ConnectionStatus:
    return document.ConnectionStatus(
        kind=relay.kind,
        name=relay.name,
        caller_id=relay.caller_id,
        peer=relay.peer,
        sent=relay.sent,
        received=relay.received,
        sent_rate=round(relay.rates[0], 1),
        received_rate=round(relay.rates[1], 1),
    )
