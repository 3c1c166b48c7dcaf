"""Admission: a node that registers through the proxy gets an endpoint and a port.

A node says where it is by its slave URI, and that may name a host which only its own container
knows. So the address that the registration came from counts where it must: see `NodeAdmission`'s
``_locate``. Another address than that one is taken only if the node there says itself that it has
the name that is being registered: else anybody could have any node published.

Ports are for nodes that live. Those that have never answered get a part of the range, by the
address that registers them; and where the range is used up, a node that answers gets the port of
one that doesn't, whose registrations are taken back (`_make_room`). So neither dead URIs nor stale
claims of former proxies keep a port from it.

Log messages begin with the address that registers, so that whoever makes up names is one subject,
for which the log has a bound (`rosproxy.telemetry.logs`).

A new node is probed at once, so that one which can't be reached is reported at once; a node that
registers again is taken for alive, whatever was believed of it.
"""

import asyncio
import errno
import logging
from typing import Protocol

from rosproxy.binding import PORTS
from rosproxy.net.addresses import HostPort, is_loopback
from rosproxy.net.resolver import resolve
from rosproxy.ros1.context import Context
from rosproxy.ros1.leases import Leases
from rosproxy.ros1.protocol.master_methods import method_spec
from rosproxy.ros1.protocol.uris import parse_service_uri, parse_slave_uri, with_caller_address
from rosproxy.ros1.protocol.xmlrpc.document import Call
from rosproxy.ros1.registry.client_kinds import ClientKind
from rosproxy.ros1.registry.endpoint import Endpoint, NodeLocation
from rosproxy.ros1.registry.node_health import ProbeResult
from rosproxy.ros1.registry.registry import RangeExhausted
from rosproxy.ros1.rewriting.addressing import Caller
from rosproxy.ros1.rewriting.master_calls import (
    CallOutcome,
    LocalAnswer,
    Passing,
    refusal,
    registering_uri,
)

log = logging.getLogger(__name__)

PATIENCE = 15.0
"""Seconds that a node has to answer for the first time where many of its source have not: all nodes
of a machine that has just started may be slow at once."""
PATIENCE_STEP = 0.2
MOST_ADDRESSES = 4
"""How many addresses of a host name are tried."""
RETIRED = "rosproxy: this proxy is retired and accepts no registrations"


class Cleanup(Protocol):
    """Takes back at the master what a node has that does not answer."""

    async def give_up(self, endpoint: Endpoint, /) -> None:
        """Unregister it. Raises Unreachable."""


class Verification(Protocol):
    """Asks nodes that only the master tells of; see `rosproxy.ros1.upkeep.recovery`."""

    async def wait_for_dead_claim(self) -> None:
        """Wait a moment until one of them turns out dead."""


class NodeAdmission:
    """Gives endpoints to nodes that register."""

    def __init__(
        self,
        context: Context,
        leases: Leases,
        cleanup: Cleanup,
        verification: Verification,
    ) -> None:
        self._context = context
        self._leases = leases
        self._cleanup = cleanup
        self._verification = verification
        self._making_room = asyncio.Lock()

    async def admit(self, call: Call, caller: Caller) -> CallOutcome:
        """The endpoint of a call that registers, or why there is none.

        Raises Unreachable if the master is needed and away.
        """
        uri = registering_uri(call)
        if uri is None:
            return Passing.NO_REGISTRATION
        if self._context.retired:
            return refusal(RETIRED)
        uri = with_caller_address(uri, caller.address)
        node = parse_slave_uri(uri)
        endpoint = self._context.registry.admitted(node, caller.address)
        # One that has never answered where it was believed to be is located anew.
        if endpoint is not None and not endpoint.never_found:
            return await self._admit_again(endpoint, uri, call, caller)
        if node is None:
            return refusal(
                f"rosproxy: caller_api {uri[:200]!r} is not of the form http://host:port/"
            )
        if self._context.addressing.is_own_uri(uri, caller):
            return Passing.FOREIGN_URI
        return await self._admit_new(uri, node, call, caller)

    async def _admit_again(
        self, endpoint: Endpoint, uri: str, call: Call, caller: Caller
    ) -> Endpoint | LocalAnswer:
        """The endpoint that a URI has meant before, for a node that is there.

        Somebody else at a source that hides several has to bear out its name as well.
        """
        caller_id = call.string(0) or ""
        location = endpoint.location
        if location.address != caller.address and caller_id not in endpoint.caller_ids:
            name = await self._context.nodes.name(endpoint.slave, _service(call, caller))
            if name != caller_id:
                return refusal(
                    f"rosproxy: {endpoint.uri[:200]} is not the address of {caller_id[:200]}: the "
                    f"node at this address has the name {(name or 'none')[:200]}. Set ROS_IP where "
                    f"{caller_id[:200]} runs"
                )
        if location.address == caller.address:
            endpoint.uri = uri  # a recovery knows no more of it than the host and port
        self._welcome_back(endpoint, caller)
        return endpoint

    async def _admit_new(self, uri: str, node: HostPort, call: Call, caller: Caller) -> CallOutcome:
        """The endpoint of a node that has not registered from there before; see `admit`."""
        location = await self._locate(node, call, caller)
        if location is None:
            return Passing.FOREIGN_URI
        admitted = await self.take_in(uri, node, location, caller)
        if isinstance(admitted, Endpoint):
            await self._leases.cleared(admitted)
            first_probe = self._probe_first(admitted, caller.caller_id)
            self._context.tasks.spawn(first_probe, f"first probe of {uri}")
        return admitted

    async def take_in(
        self,
        uri: str,
        node: HostPort,
        location: NodeLocation,
        caller: Caller,
        answers: bool = False,
    ) -> Endpoint | LocalAnswer:
        """The endpoint of a node found at a place, its port open; a refusal if none is left.

        Ports that turn out to be taken are passed over. ``answers``: the node has just done so.
        Raises Unreachable.
        """
        registry = self._context.registry
        problems = self._context.problems
        slave = HostPort(location.address, node.port)
        source = caller.address
        if slave not in registry.by_slave and not answers and self._is_crowded(source):
            answers = await self._comes_to_answer(slave, source)
            if not answers and self._is_crowded(source):
                return self._refuse(uri, caller, _crowd_text(source, slave, registry.most_unproven))
        while True:
            try:
                endpoint = registry.admit(uri, node, location, source)
            except RangeExhausted as error:
                answers = answers or await self._answers(slave)
                # One after the other: whoever has waited may find a port that was freed meanwhile,
                # and then displaces nobody.
                async with self._making_room:
                    room = registry.pool.free or await self._make_room(answers)
                if room:
                    continue
                return self._refuse(uri, caller, str(error))
            failure = self._open(endpoint, answers)
            # What the master has of a node leads to this port: such a node keeps it even if another
            # program has taken it.
            if self._leases.is_open(endpoint) or endpoint.registrations:
                return endpoint
            registry.remove(endpoint)
            problems.solved_at(endpoint.port)  # `open` has reported it as this node's
            if text := _fault_of_all_ports(endpoint.port, failure):
                return self._refuse(uri, caller, text)
            registry.pool.block(endpoint.port)
            problems.add(PORTS, f"another program has taken port {endpoint.port}")

    def _open(self, endpoint: Endpoint, answers: bool) -> OSError | None:
        """Open the port of an endpoint whose node ``answers`` or not; the error if that fails."""
        if answers:
            endpoint.health.note(ProbeResult.ANSWERED, self._context.now())
        return self._leases.open(endpoint)

    async def _make_room(self, answers: bool) -> bool:
        """Free a port for a new node, if one can be had.

        Only one that ``answers`` displaces others. Raises Unreachable.
        """
        # What is missed least goes first: a fast port, without which topics only take the lease; a
        # dead node's port; a lease that nobody uses, which its node would get again.
        if self._leases.give_up_spare():
            return True
        if answers and await self._give_up_dead():
            return True
        if self._leases.end_idle():
            return True
        if not answers:
            return False
        await self._verification.wait_for_dead_claim()
        return self._context.registry.pool.free > 0 or await self._give_up_dead()

    async def _give_up_dead(self) -> bool:
        """Unregister a node that is dead and end its lease; whether there was one.

        It may have come back while the master was told: then it keeps its port.
        """
        registry = self._context.registry
        endpoint = registry.dead_endpoint()
        if endpoint is None:
            return False
        label = endpoint.label
        port = endpoint.port
        fields = endpoint.log_fields
        text = "%s: %s does not answer. Its port %d goes to another node"
        await self._cleanup.give_up(endpoint)
        if registry.by_port.get(port) is endpoint and endpoint.expendable:
            self._leases.end(endpoint)
            log.warning(text, endpoint.source, label, port, extra=fields)
        return True

    def _is_crowded(self, source: str) -> bool:
        """Whether a source has all the nodes that it may have which have never answered.

        Those that have no registration left are given up for new ones.
        """
        registry = self._context.registry
        while len(unproven := registry.unproven(source)) >= registry.most_unproven:
            unused = next((e for e in unproven if e.unused and e.idle_since is not None), None)
            if unused is None:
                return True
            self._leases.end(unused)
        return False

    async def _comes_to_answer(self, slave: HostPort, source: str) -> bool:
        """Whether a node answers, in the time that it may take on a machine that just starts.

        Nobody waits for it once it is known not to be there, or not needed to be.
        """
        end = self._context.now() + PATIENCE
        while True:
            answer = await self._context.nodes.probe(slave)
            if answer.probe is ProbeResult.ANSWERED:
                return True
            is_over = self._context.now() >= end
            if answer.probe is ProbeResult.REFUSED or is_over or not self._is_crowded(source):
                return False
            await asyncio.sleep(PATIENCE_STEP)

    async def _answers(self, slave: HostPort) -> bool:
        return (await self._context.nodes.probe(slave)).probe is ProbeResult.ANSWERED

    def _refuse(self, uri: str, caller: Caller, text: str) -> LocalAnswer:
        self._context.metrics.exhausted.inc()
        self._context.problems.add(caller.caller_id, text)
        log.error("%s: %s (%s) gets no port: %s", caller.address, caller.caller_id, uri, text)
        return refusal(text)

    def _welcome_back(self, endpoint: Endpoint, caller: Caller) -> None:
        """A node that registers is alive, whatever was believed of it."""
        if not endpoint.location.confirmed and endpoint.location.address == caller.address:
            endpoint.confirm()
            self._context.problems.solved_at(endpoint.port)
        if endpoint.trusted:  # if not, its node has yet to bear out what the master has of it
            self._leases.open(endpoint)
        names = endpoint.caller_ids
        if endpoint.health.down or (names and caller.caller_id not in names):
            endpoint.health.suspect()

    async def _locate(self, node: HostPort, call: Call, caller: Caller) -> NodeLocation | None:
        """Where a node is that gives ``node`` as its address; None if that is outside.

        If the address leads elsewhere than to the source of the call, and no node answers at the
        source (the way to the proxy hides it), the node there must bear out that it has the name
        that the call registers. Outside it need only be there: a gateway registers nodes of another
        machine under names of its own, and no port is opened for that.
        """
        source = caller.address
        caller_id = call.string(0) or ""
        addresses = await resolve(self._context.upstream.reach(node).host, source)
        candidates = [address for address in addresses if not is_loopback(address)]
        if source in addresses or not candidates:
            return NodeLocation(source, named=source in addresses)
        if await self._answers(HostPort(source, node.port)):
            return NodeLocation(source, named=False)
        service = _service(call, caller)
        for address in candidates[:MOST_ADDRESSES]:
            slave = HostPort(address, node.port)
            client_kind = self._context.client_kind(address)
            if client_kind is ClientKind.OUTSIDE:
                bears_out = await self._answers(slave)  # a gateway gives it another name
            else:
                bears_out = await self._context.nodes.name(slave, service) == caller_id
            if bears_out and client_kind is ClientKind.ADMITTED:
                return NodeLocation(address, named=True, confirmed=False)
            if bears_out:
                log.info(
                    "%s at %s is outside: the proxy does not rewrite its URI", caller_id, slave
                )
                return None
        text = (
            f"gives its address as {node}, but registers from {source}. No node answers at "
            f"{HostPort(source, node.port)}, and no node with this name answers at "
            f"{', '.join(candidates[:MOST_ADDRESSES])}. Set ROS_IP where the node runs"
        )
        self._context.problems.add(caller_id, text)
        log.warning("%s: %s %s", source, caller_id, text)
        return NodeLocation(source, named=False)

    async def _probe_first(self, endpoint: Endpoint, caller_id: str) -> None:
        """Look at once whether a new node can be reached, and say so if not."""
        answer = await self._context.nodes.probe(endpoint.slave)
        endpoint.health.note(answer.probe, self._context.now())
        endpoint.health.pid = answer.pid
        uri = self._context.addressing.advertised_uri(endpoint)
        log.info("%s at %s is advertised as %s", caller_id[:200], endpoint.uri[:200], uri[:200])
        if answer.probe is ProbeResult.ANSWERED and not _on_loopback(endpoint):
            return
        text = _unreachable_text(endpoint, answer.reason)
        self._context.problems.add(caller_id, text, endpoint.port)
        log.warning("%s: %s %s", endpoint.source, caller_id, text)


def _service(call: Call, caller: Caller) -> tuple[str, int] | None:
    """The service that a call registers, and its port; None if it registers another thing."""
    spec = method_spec(call.method)
    service = parse_service_uri(
        with_caller_address(call.string(spec.service_api) or "", caller.address)
    )
    return (call.string(spec.name) or "", service.port) if service else None


def _crowd_text(source: str, slave: HostPort, most: int) -> str:
    return (
        f"rosproxy: {slave} does not answer. {source} has registered {most} nodes that have never "
        "answered; the proxy keeps no more ports for such nodes. Check ROS_IP where these nodes "
        "run, and that no firewall or network policy blocks the proxy"
    )


def _on_loopback(endpoint: Endpoint) -> bool:
    """Whether a node of another machine gives a loopback address.

    Then roscpp, too, accepts TCPROS connections on loopback only, though its slave API answers
    (transport_tcp.cpp, isOnlyLocalhostAllowed).
    """
    return is_loopback(endpoint.node.host) and not is_loopback(endpoint.location.address)


def _unreachable_text(endpoint: Endpoint, reason: str) -> str:
    if _on_loopback(endpoint):
        return (
            f"gives its address as {endpoint.uri}, a loopback address. The node listens on "
            "loopback only, so no other machine can reach the node. Unset ROS_IP and ROS_HOSTNAME "
            f"where the node runs, or set ROS_IP={endpoint.location.address}"
        )
    return (
        f"can't be reached by the proxy at {endpoint.slave} ({reason}). Check that the node "
        "listens on this address, and that no firewall or network policy blocks the proxy"
    )


def _fault_of_all_ports(port: int, failure: OSError | None) -> str:
    """Why no port can be opened, if that is so; empty if another program has this port alone."""
    if failure is None or failure.errno == errno.EADDRINUSE:
        return ""
    return f"rosproxy: port {port} can't be opened: {failure.strerror}"
