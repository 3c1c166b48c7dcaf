"""Gathering the facts for ``rosproxy doctor``: asks the proxy, the master and the nodes.

First the proxy (`AdminClient`), which knows its nodes and whether its ports can be reached; then
the master for who publishes, subscribes to and provides what (``getSystemState``, ``lookupNode``);
then every node whether it answers; then, where names were given, those nodes for their topics and
connections (``getBusInfo``) and their data ports. The rules judge what was found.

It changes nothing, apart from the short-lived parameter by which the proxy has the master try its
ports (see `range_probe`). Names and addresses are tried from where it runs; that should be where
the proxy runs.
"""

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TypeVar
from urllib.parse import urlsplit
from xmlrpc.client import Fault, loads

import aiohttp

from rosproxy.admin.client import AdminClient, AdminError
from rosproxy.admin.requests import RangeProbe
from rosproxy.doctor import replies
from rosproxy.doctor.facts import (
    Attempt,
    DoctorFacts,
    MasterFacts,
    NodeFacts,
    Reach,
    SlaveReport,
    scope,
)
from rosproxy.doctor.rules.pair import connected
from rosproxy.net.addresses import HostPort, parse_host_port
from rosproxy.net.resolver import resolve
from rosproxy.ros1.clients.master import CALLER_ID, MasterClient, MasterError, Unreachable
from rosproxy.ros1.protocol.tcpros import HeaderError, decode_header, encode_header, header_length
from rosproxy.ros1.protocol.uris import parse_service_uri, parse_slave_uri
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.telemetry.metrics import Metrics

PARALLEL = 32
"""Questions under way at once; fewer than the look-ups of names that may be."""
WITHIN = 3.0
"""Seconds that a node has to answer."""

Key = TypeVar("Key")
Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class DoctorOptions:
    """What to look at: the admin endpoint, and what is known in case that it doesn't answer.

    Without ``admin`` no proxy is asked: the look of an outside machine. ``master_address`` is the
    IP address at which the master's host is reached whatever its name leads to.
    """

    admin: AdminClient | None
    master_uri: str = ""
    advertise_host: str = ""
    names: tuple[str, ...] = ()
    master_address: str | None = None


async def collect(options: DoctorOptions) -> DoctorFacts:
    """Ask everybody, and change nothing."""
    host = options.advertise_host
    facts = DoctorFacts(
        advertise_host=host,
        advertised_addresses=tuple(await resolve(host)) if host else (),
        names=options.names,
    )
    if options.admin is None:
        return await _look_beyond(facts, _Target(options.master_uri))
    try:
        return await _with_proxy(facts, options.admin)
    except AdminError as error:
        facts = replace(facts, admin_error=str(error))
        return await _look_beyond(facts, _Target(options.master_uri, "", options.master_address))


async def _with_proxy(facts: DoctorFacts, admin: AdminClient) -> DoctorFacts:
    status = await asyncio.to_thread(admin.status)
    host = status.settings.advertise_host
    facts = replace(facts, admin=admin.url, status=status, advertise_host=host)
    master = status.master
    target = _Target(master.uri, status.instance, master.address if master.pinned else None)
    beyond = asyncio.create_task(_look_beyond(facts, target))
    probe, reason = await _probe(admin)
    return replace(await beyond, probe=probe, probe_error=reason)


async def _probe(admin: AdminClient) -> tuple[RangeProbe | None, str]:
    """What the proxy finds out about its range, or why it could not be asked."""
    try:
        return await asyncio.to_thread(admin.probe), ""
    except AdminError as error:
        return None, str(error)


@dataclass(frozen=True, slots=True)
class _Target:
    """The master to ask, in the name of which proxy, and its host's address if that is given."""

    uri: str
    instance: str = ""
    address: str | None = None


async def _look_beyond(facts: DoctorFacts, target: _Target) -> DoctorFacts:
    """What the master and the nodes say."""
    if not target.uri:
        return facts
    as_doctor = replace(target, instance="doctor")
    async with _master_client(target) as master, _master_client(as_doctor) as nodes:
        collector = _Collector(master, nodes)
        facts = replace(
            facts,
            master=await collector.master(),
            published_master=await collector.published_master(facts),
        )
        if facts.master and facts.master.attempt.reach is Reach.ANSWERED:
            with contextlib.suppress(Unreachable, MasterError):
                facts = await collector.master_state(facts)
    return facts


@contextlib.asynccontextmanager
async def _master_client(target: _Target) -> AsyncIterator[MasterClient]:
    client = MasterClient(target.uri, target.instance, Metrics(), target.address)
    try:
        yield client
    finally:
        await client.close()


class _Collector:
    """Questions to the master and to nodes, a bounded number at once.

    The master is asked in the proxy's name, so that a proxy that is its own master shows itself;
    nodes are not, since those behind the proxy are asked through it.
    """

    def __init__(self, master: MasterClient, nodes: MasterClient) -> None:
        self._master, self._nodes = master, nodes
        self._limit = asyncio.Semaphore(PARALLEL)

    async def master(self) -> MasterFacts:
        """Look at the master: its name, its answer, its path, and whether it is the proxy."""
        uri = self._master.master_uri
        found = MasterFacts(uri, addresses=tuple(await self._master.master_addresses()))
        if not found.addresses:
            return replace(found, attempt=Attempt(Reach.UNRESOLVABLE))
        started = time.monotonic()
        attempt, looped = await self._ask_master()
        found = replace(
            found,
            attempt=attempt,
            looped=looped,
            round_trip=time.monotonic() - started,
        )
        if attempt.reach is Reach.STRANGER and urlsplit(uri).path not in ("", "/"):
            found = replace(found, at_root=await self._answers_at_root(uri))
        return found

    async def published_master(self, facts: DoctorFacts) -> Attempt:
        """Try the master as outside is offered it (``--publish-master``)."""
        port = facts.status.settings.publish_master if facts.status else None
        return await self._ask_pid(HostPort(facts.advertise_host, port)) if port else Attempt()

    async def master_state(self, facts: DoctorFacts) -> DoctorFacts:
        """What the master knows, and who of it answers. Raises Unreachable, MasterError."""
        ask = self._master.call_master
        graph = replies.system_state(await ask("getSystemState"))
        names, services = sorted(graph.names()), sorted(graph.services)
        uris = await self._look_up("lookupNode", names)
        facts = replace(
            facts,
            graph=graph,
            clock=await self._simulated_time(),
            service_uris=await self._look_up("lookupService", services),
        )
        nodes = {name: NodeFacts(name, uris.get(name, "")) for name in names}
        involved = scope(graph, facts.names)
        tried = {n: nodes[n] for n in (involved.nodes if facts.names else names)}
        nodes |= await _gather(tried, lambda node: self._try_node(facts, node))
        facts = replace(facts, nodes=nodes)
        if facts.names:
            facts = await self._examine_named(facts)
        return facts

    async def _examine_named(self, facts: DoctorFacts) -> DoctorFacts:
        """Ask the nodes and services that the user named."""
        asked = {name: facts.nodes[name] for name in facts.scope.nodes}
        described = {**facts.nodes, **await _gather(asked, lambda n: self._ask_node(facts, n))}
        apart = {
            (giver, topic): (described[giver], topic)
            for topic, giver, taker in facts.scope.pairs
            if not connected(topic, described[giver], described[taker])
        }
        ports = await _gather(apart, lambda item: self._try_data_port(facts, *item))
        services = {name: name for name in facts.scope.services}
        return replace(
            facts,
            nodes=described,
            data_ports=ports,
            services=await _gather(services, lambda name: self._try_service(facts, name)),
        )

    async def _ask_master(self) -> tuple[Attempt, bool]:
        """How the master answers ``getPid``, and whether it is the proxy that refuses a loop."""
        try:
            reply = await self._master.post_to_master(xmlrpc.dump_call("getPid", CALLER_ID))
            xmlrpc.parse_reply(reply)
            loads(reply)
        except Unreachable as error:
            return _failed_attempt(error), False
        except Fault as fault:
            looped = "leads back to the proxy itself" in str(fault.faultString)
            return Attempt(Reach.STRANGER, str(fault.faultString)[:200]), looped
        except xmlrpc.XmlRpcError as error:
            return Attempt(Reach.STRANGER, str(error)), False
        return Attempt(Reach.ANSWERED), False

    async def _answers_at_root(self, uri: str) -> bool:
        where = parse_slave_uri(uri)
        return where is not None and (await self._ask_pid(where)).reach is Reach.ANSWERED

    async def _simulated_time(self) -> bool:
        try:
            said = await self._master.call_master("getParam", "/use_sim_time")
        except MasterError:
            return False
        return said in ("1", "true", 1)

    async def _look_up(self, method: str, names: Iterable[str]) -> dict[str, str]:
        wanted = list(names)
        found = await self._master.multicall([(method, [CALLER_ID, name]) for name in wanted])
        pairs = zip(wanted, found, strict=False)
        return {name: uri for name, uri in pairs if isinstance(uri, str)}

    async def _try_node(self, facts: DoctorFacts, node: NodeFacts) -> NodeFacts:
        """Try a node at its address; one behind this proxy is the proxy's to judge."""
        where = node.where
        if where is None or facts.ours(where):
            return node
        async with self._limit:
            addresses = tuple(await resolve(self._nodes.reach(where).host))
            attempt = await self._ask_pid(where) if addresses else Attempt(Reach.UNRESOLVABLE)
        return replace(node, addresses=addresses, attempt=attempt)

    async def _ask_pid(self, where: HostPort) -> Attempt:
        try:
            pid = await self._nodes.call_node(where, WITHIN, "getPid")
        except (Unreachable, MasterError) as error:
            return _failed_attempt(error)
        if isinstance(pid, int):
            return Attempt(Reach.ANSWERED)
        return Attempt(Reach.STRANGER, "its answer is not a node's")

    async def _ask_node(self, facts: DoctorFacts, node: NodeFacts) -> NodeFacts:
        """What a node says of itself, asked through the proxy if it is behind it."""
        where = _slave_address(facts, node)
        if where is None or node.attempt.failed:
            return node
        try:
            async with self._limit:
                report = await self._ask_slave(where)
        except (Unreachable, MasterError):
            return node
        return replace(node, report=report)

    async def _ask_slave(self, where: HostPort) -> SlaveReport:
        methods = ("getPublications", "getSubscriptions", "getBusInfo")
        ask = self._nodes.call_node
        return replies.slave_report(*[await ask(where, WITHIN, method) for method in methods])

    async def _try_data_port(
        self, facts: DoctorFacts, node: NodeFacts, topic: str
    ) -> tuple[str, Attempt]:
        """Where a publisher serves a topic, and whether a subscriber gets through to there."""
        where = _slave_address(facts, node)
        if where is None or node.report is None:
            return "", Attempt()
        try:
            answer = await self._nodes.call_node(where, WITHIN, "requestTopic", topic, [["TCPROS"]])
        except (Unreachable, MasterError) as error:
            return "", _failed_attempt(error)
        target = replies.data_port(answer)
        if target is None:
            return "", Attempt(Reach.STRANGER, "no TCPROS address")
        if facts.ours(node.where):
            return str(target), Attempt()
        probe = {"callerid": CALLER_ID, "topic": topic, "type": "*", "md5sum": "*"}
        return str(target), await _shake_hands(self._nodes.reach(target), probe)

    async def _try_service(self, facts: DoctorFacts, service: str) -> Attempt:
        """Ask a service for its type, as rosservice does."""
        where = parse_service_uri(facts.service_uris.get(service, ""))
        if where is None:
            return Attempt(Reach.STRANGER, "no address")
        if facts.ours(where):
            where = _lease_address(facts, where.port)
        if where is None:
            return Attempt(Reach.REFUSED, "its port is not held by a node")
        header = {"callerid": CALLER_ID, "service": service, "md5sum": "*", "probe": "1"}
        return await _shake_hands(self._nodes.reach(where), header)


def _slave_address(facts: DoctorFacts, node: NodeFacts) -> HostPort | None:
    """Where to ask a node: behind this proxy at its port of the proxy, else at its own address."""
    if node.where and facts.ours(node.where):
        return _lease_address(facts, node.where.port)
    return node.where


def _lease_address(facts: DoctorFacts, advertised: int) -> HostPort | None:
    """The port of the proxy behind an advertised one, as it is reached without the host's NAT."""
    lease = facts.leases.get(advertised)
    admin = parse_host_port(facts.admin.removeprefix("http://"))
    if lease is None or facts.status is None or admin is None:
        return None
    bound = facts.status.settings.bind
    host = admin.host if bound in ("0.0.0.0", "::") else bound
    return HostPort(host, lease.port)


async def _shake_hands(where: HostPort, header: Mapping[str, str]) -> Attempt:
    """Exchange TCPROS connection headers."""
    try:
        async with asyncio.timeout(WITHIN), _connected(where) as (reader, writer):
            writer.write(encode_header(header))
            length = header_length(await reader.readexactly(4))
            reply = decode_header(await reader.readexactly(length))
    except UnknownHost:
        return Attempt(Reach.UNRESOLVABLE)
    except (ConnectionError, EOFError):
        return Attempt(Reach.REFUSED)
    except OSError:
        return Attempt(Reach.SILENT)
    except HeaderError as error:
        return Attempt(Reach.STRANGER, str(error))
    if "error" in reply:
        return Attempt(Reach.STRANGER, reply["error"])
    return Attempt(Reach.ANSWERED)


class UnknownHost(OSError):
    """A host name without an address."""


@contextlib.asynccontextmanager
async def _connected(
    where: HostPort,
) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
    """A connection. Raises UnknownHost, OSError."""
    addresses = await resolve(where.host)
    if not addresses:
        raise UnknownHost(where.host)
    reader, writer = await asyncio.open_connection(addresses[0], where.port)
    try:
        yield reader, writer
    finally:
        writer.close()


def _failed_attempt(error: Unreachable | MasterError) -> Attempt:
    """An attempt that failed: did nobody answer, or somebody who is no node or master?"""
    if isinstance(error, Unreachable) and error.refused:
        return Attempt(Reach.REFUSED)
    if isinstance(error.__cause__, aiohttp.ClientOSError | TimeoutError):
        return Attempt(Reach.SILENT)
    return Attempt(Reach.STRANGER, _brief(str(error)))


def _brief(text: str) -> str:
    """The first line of what a stranger said."""
    return text.partition("\n")[0].rpartition(": ")[2][:120] or "no sense"


async def _gather(
    items: Mapping[Key, Item], work: Callable[[Item], Awaitable[Result]]
) -> dict[Key, Result]:
    """The results of ``work`` on each item, by the same keys, all at the same time."""
    results = await asyncio.gather(*(work(item) for item in items.values()))
    return dict(zip(items, results, strict=True))
