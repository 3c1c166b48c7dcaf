"""Admission: a node that registers through the proxy gets an endpoint and a port.

A slave URI may name a host that only the node's own container can resolve. So the source address of
the registration counts in many cases: see `NodeAdmission`'s ``_locate``. The proxy takes another
address only if the node there confirms the registered name. Otherwise any node could make the proxy
publish any other node.

Ports are for live nodes. Nodes that have never answered get a part of the range, by source. If the
range is used up, a node that answers gets the port of a node that does not answer, and the proxy
takes back the registrations of the latter (`_make_room`). So neither dead URIs nor stale claims of
former proxies keep a port from a live node.

Log messages begin with the source address. So a source that makes up names is a single subject, and
the log bounds the lines of a subject (`rosproxy.shared.output.logs`).

The proxy probes a new node at once, to report at once if the node is unreachable. If a node
registers again, its port listens again, even if the node counted as dead.
"""

import asyncio
import errno
import logging
from typing import Protocol

from rosproxy.binding import PORTS
from rosproxy.ros1.clients.master_client import Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.leases import Leases
from rosproxy.ros1.registry.client_kinds import ClientKind
from rosproxy.ros1.registry.endpoint import Endpoint, NodeLocation
from rosproxy.ros1.registry.node_health import ProbeResult
from rosproxy.ros1.registry.registry import RangeExhausted
from rosproxy.ros1.rewriting.addressing import Caller
from rosproxy.ros1.rewriting.master_calls import (
    CallOutcome,
    LocalAnswer,
    MasterCall,
    Passing,
    refusal,
)
from rosproxy.shared.addresses import HostPort, is_loopback
from rosproxy.shared.machine.resolver import resolve
from rosproxy.shared.uris import parse_service_uri, parse_slave_uri, with_caller_address

log = logging.getLogger(__name__)

FIRST_ANSWER_TIMEOUT_S = 15.0
"""Seconds for a first answer if many nodes of the source have not answered yet: all nodes of a
machine that has just started may be slow."""
FIRST_ANSWER_RETRY_S = 0.2
"""Seconds between two questions to such a node."""
MOST_ADDRESSES = 4
"""The highest number of addresses that the proxy tries for a host name."""
RETIRED = "this proxy is retired and accepts no registrations"


class Cleanup(Protocol):
    """Takes back the registrations of a node that does not answer."""

    async def give_up(self, endpoint: Endpoint, /) -> None:
        """Unregister the node. Raises Unreachable."""


class Verification(Protocol):
    """Verifies nodes that only the master mentions; see `rosproxy.ros1.upkeep.recovery`."""

    async def wait_for_dead_claim(self) -> None:
        """Wait until a node under verification turns out dead, or the time for this is over."""


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

    async def admit(self, call: MasterCall, caller: Caller) -> CallOutcome:
        """The endpoint of a call that registers, or the reason why there is none.

        Raises Unreachable if the master is needed and does not answer, and if the proxy is retired:
        a node tries again without an answer, and so registers at the next proxy.
        """
        uri = call.registering_uri
        if uri is None:
            return Passing.NO_REGISTRATION
        if self._context.retired:
            raise Unreachable(RETIRED)
        uri = with_caller_address(uri, caller.address)
        node = parse_slave_uri(uri)
        endpoint = self._context.registry.admitted(node, caller.address)
        # A node that has never answered at its location is located anew.
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
        self, endpoint: Endpoint, uri: str, call: MasterCall, caller: Caller
    ) -> Endpoint | LocalAnswer:
        """The endpoint that a URI has meant before, for a node that registers again.

        If another node behind the same source registers, that node has to confirm its name as well.
        """
        caller_id = call.caller_id
        location = endpoint.location
        if location.address != caller.address and caller_id not in endpoint.callers:
            name = await self._context.nodes.name(endpoint.slave, _service(call, caller))
            if name != caller_id:
                return refusal(
                    f"rosproxy: {endpoint.uri[:200]} is not the address of {caller_id[:200]}: the "
                    f"node at this address has the name {(name or 'none')[:200]}. Set ROS_IP where "
                    f"{caller_id[:200]} runs"
                )
        if location.address == caller.address:
            endpoint.uri = uri  # after a recovery the endpoint has only host and port
        self._welcome_back(endpoint, caller)
        return endpoint

    async def _admit_new(
        self, uri: str, node: HostPort, call: MasterCall, caller: Caller
    ) -> CallOutcome:
        """The endpoint of a node that is new at this URI; see `admit`."""
        location = await self._locate(node, call, caller)
        if location is None:
            return Passing.FOREIGN_URI
        admitted = await self.take_in(uri, node, location, caller)
        if isinstance(admitted, Endpoint):
            await self._leases.wait_until_unforwarded(admitted)
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
        """The endpoint of a node at a location, with an open port; a refusal if no port is left.

        The method skips ports that other programs have taken. ``answers``: the node has just
        answered. Raises Unreachable.
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
                # One after the other: a waiting node may find a port that was freed meanwhile, and
                # then displaces no other node.
                async with self._making_room:
                    room = registry.pool.free or await self._make_room(answers)
                if room:
                    continue
                return self._refuse(uri, caller, str(error))
            failure = self._open(endpoint, answers)
            # The master has this port for a registered node. So such a node keeps the port even if
            # another program has taken the port.
            if self._leases.is_open(endpoint) or endpoint.registrations:
                return endpoint
            registry.remove(endpoint)
            problems.solved_at(endpoint.port)  # `open` has reported it for this node
            if text := _fault_of_all_ports(endpoint.port, failure):
                return self._refuse(uri, caller, text)
            registry.pool.block(endpoint.port)
            problems.add(PORTS, f"another program has taken port {endpoint.port}")

    def _open(self, endpoint: Endpoint, answers: bool) -> OSError | None:
        """Open the port of an endpoint; return the error if that fails.

        ``answers``: the node has just answered, so the method records this first.
        """
        if answers:
            endpoint.health.note(ProbeResult.ANSWERED, self._context.now())
        return self._leases.open(endpoint)

    async def _make_room(self, answers: bool) -> bool:
        """Free a port for a new node; return whether that was possible.

        Only a node that ``answers`` displaces other nodes. Raises Unreachable.
        """
        # The least useful port goes first: a fast port, whose topics then take the lease; a dead
        # node's port; an unused lease, which its node would get again.
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
        """Unregister a dead node and end its lease; return whether there was a dead node.

        If the node comes back during the call to the master, the node keeps its port.
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
        """Whether a source has `most_unproven` nodes that have never answered.

        The method first ends the leases of such nodes that are without a registration.
        """
        registry = self._context.registry
        while len(unproven := registry.unproven(source)) >= registry.most_unproven:
            unused = next((e for e in unproven if e.unused and e.idle_since is not None), None)
            if unused is None:
                return True
            self._leases.end(unused)
        return False

    async def _comes_to_answer(self, slave: HostPort, source: str) -> bool:
        """Whether a node answers within FIRST_ANSWER_TIMEOUT_S.

        The wait ends as soon as the node refuses connections, or the source is no longer crowded.
        """
        end = self._context.now() + FIRST_ANSWER_TIMEOUT_S
        while True:
            answer = await self._context.nodes.probe(slave)
            if answer.probe is ProbeResult.ANSWERED:
                return True
            is_over = self._context.now() >= end
            if answer.probe is ProbeResult.REFUSED or is_over or not self._is_crowded(source):
                return False
            await asyncio.sleep(FIRST_ANSWER_RETRY_S)

    async def _answers(self, slave: HostPort) -> bool:
        return (await self._context.nodes.probe(slave)).probe is ProbeResult.ANSWERED

    def _refuse(self, uri: str, caller: Caller, text: str) -> LocalAnswer:
        self._context.metrics.exhausted.inc()
        self._context.problems.add(caller.caller_id, text)
        log.error("%s: %s (%s) gets no port: %s", caller.address, caller.caller_id, uri, text)
        return refusal(text)

    def _welcome_back(self, endpoint: Endpoint, caller: Caller) -> None:
        """Serve a node that registers again, whatever the state of its endpoint.

        The prober checks the node soon if the node counted as dead, or if its name is new.
        """
        if not endpoint.location.confirmed and endpoint.location.address == caller.address:
            endpoint.confirm()
            self._context.problems.solved_at(endpoint.port)
        # A node that is not trusted still has to confirm its registrations.
        if endpoint.trusted and not self._leases.is_open(endpoint):
            self._leases.open(endpoint)
        names = endpoint.callers
        if endpoint.health.down or (names and caller.caller_id not in names):
            endpoint.health.suspect()

    async def _locate(
        self, node: HostPort, call: MasterCall, caller: Caller
    ) -> NodeLocation | None:
        """The location of a node that gives ``node`` as its address; None if this is outside.

        The node usually is at the source of the call. But NAT on the way to the proxy may hide the
        node's address. Then no node answers at the source, and ``node`` resolves to other
        addresses. A node there has to confirm the name that the call registers. A node outside only
        has to answer: a gateway registers nodes of another machine under different names, and the
        proxy opens no port for such a node.
        """
        source = caller.address
        caller_id = call.caller_id
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
                is_confirmed = await self._answers(slave)  # a gateway gives the node another name
            else:
                is_confirmed = await self._context.nodes.name(slave, service) == caller_id
            if is_confirmed and client_kind is ClientKind.ADMITTED:
                return NodeLocation(address, named=True, confirmed=False)
            if is_confirmed:
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
        """Probe a new node at once. Report an unreachable node, and a loopback address."""
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


def _service(call: MasterCall, caller: Caller) -> tuple[str, int] | None:
    """The service that a call registers, and its port; None if the call registers no service."""
    spec = call.spec
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

    roscpp then accepts TCPROS connections on loopback only, although its slave API answers
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
    """Why no port can be opened; empty if another program has taken only this port."""
    if failure is None or failure.errno == errno.EADDRINUSE:
        return ""
    return f"rosproxy: port {port} can't be opened: {failure.strerror}"
