"""The state of a running proxy as JSON, for ``/status``."""

import os
import time
from typing import Any

from rosproxy import __version__
from rosproxy.forwarding.kernel.plane import KernelPlane
from rosproxy.forwarding.relay import Relay
from rosproxy.leases import fast_ports
from rosproxy.ros1.alias.alias import Alias
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.master_methods import Kind
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.servers.tcpros import TcprosServer
from rosproxy.ros1.upkeep.master_monitor import MasterMonitor
from rosproxy.telemetry.problems import Problem


def describe(
    context: Context,
    watch: MasterMonitor,
    tcpros: TcprosServer,
    mirror: Alias,
    plane: KernelPlane,
) -> dict[str, Any]:
    """Everything that ``rosproxy status`` and ``rosproxy doctor`` show.

    Times are seconds, rates bytes per second; ``sent`` is what went outside.
    """
    relays: dict[int, list[Relay]] = {}
    for relay in tcpros.relays:
        relays.setdefault(relay.port, []).append(relay)
    endpoints = sorted(context.registry, key=lambda endpoint: endpoint.port)
    return {
        "version": __version__,
        "pid": os.getpid(),
        "instance": context.instance,
        "retired": context.retired,
        "uptime": round(context.now() - context.metrics.started, 1),
        "settings": _settings(context),
        "master": _master(context, watch),
        "ports": _ports(context),
        "data_plane": plane.status(),
        "mirrored": mirror.status(),
        "nodes": [
            _node(context, e, relays.get(e.port, [])) | {"data_plane": plane.status_of(e)}
            for e in endpoints
        ],
        "problems": [_problem(problem) for problem in context.problems.all()],
    }


def _settings(context: Context) -> dict[str, Any]:
    settings = context.settings
    return {
        "master_port": settings.master_port,
        "publish_master": settings.publish_master,
        "advertise_host": settings.advertise_host,
        "bind": settings.bind,
        "inside_networks": [str(network) for network in context.addressing.networks],
        "cleanup_after": settings.cleanup_after,
        "linger": settings.linger,
    }


def _master(context: Context, watch: MasterMonitor) -> dict[str, Any]:
    return {
        "uri": context.settings.master_uri,
        "address": context.upstream.reached_at,
        "pinned": context.upstream.master_address is not None,
        "up": bool(watch.up),
        "error": watch.error,
        "pid": watch.pid,
        "since": round(context.now() - watch.since, 1),
        "round_trip": watch.round_trip,
    }


def _ports(context: Context) -> dict[str, Any]:
    ports, pool = context.settings.ports, context.registry.pool
    return {
        "listen": str(ports.listen),
        "advertise": str(ports.advertise),
        "used": len(context.registry),
        "free": fast_ports.left(pool, context.registry),
        "blocked": pool.blocked,
    }


def _node(context: Context, endpoint: Endpoint, relays: list[Relay]) -> dict[str, Any]:
    return {
        "nodes": endpoint.caller_ids,
        "uri": endpoint.uri,
        "address": str(endpoint.slave),
        "advertised_uri": context.addressing.advertised_uri(endpoint),
        "port": endpoint.port,
        "state": endpoint.state,
        "publishes": endpoint.names(Kind.PUBLISHER),
        "subscribes": endpoint.names(Kind.SUBSCRIBER),
        "services": endpoint.names(Kind.SERVICE),
        "parameters": endpoint.names(Kind.PARAM),
        "connections": [_connection(relay) for relay in relays],
        "problems": [problem.text for problem in context.problems.at(endpoint.port)],
    }


def _connection(relay: Relay) -> dict[str, Any]:
    return {
        "kind": relay.kind,
        "name": relay.name,
        "caller_id": relay.caller_id,
        "peer": relay.peer,
        "sent": relay.sent,
        "received": relay.received,
        "sent_rate": round(relay.rates[0], 1),
        "received_rate": round(relay.rates[1], 1),
    }


def _problem(problem: Problem) -> dict[str, Any]:
    age = round(time.time() - problem.when, 1)
    return {"age": age, "subject": problem.subject, "text": problem.text}
