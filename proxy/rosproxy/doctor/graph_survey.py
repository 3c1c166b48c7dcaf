"""The survey of ROS 1: the graph at the master, and which nodes answer.

1. Ask the master for all publishers, subscribers and services (``getSystemState``, ``lookupNode``).
2. Ask every node, or the nodes in the scope, whether the node answers (``getPid``).
3. With names in the user's question: ask the nodes in the scope for topics and connections
   (``getPublications``, ``getSubscriptions``, ``getBusInfo``, ``getBusStats``). Try the TCPROS
   ports of unconnected pairs, and the services in the scope.
"""

import asyncio
import contextlib
import time
from collections.abc import Awaitable, Callable, Collection, Iterable, Mapping
from typing import Any, TypeVar
from urllib.parse import urlsplit

from msgspec.structs import replace

from rosproxy.doctor.facts import (
    Attempt,
    DoctorFacts,
    MasterFacts,
    NodeFacts,
    ReachOutcome,
    SystemState,
    data_port,
    slave_report,
    system_state,
)
from rosproxy.doctor.rules.pair import is_connected
from rosproxy.ros1.clients.master_client import CALLER_ID, MasterClient, MasterError, Unreachable
from rosproxy.ros1.protocol.tcpros import HeaderError, decode_header, encode_header, header_length
from rosproxy.ros1.protocol.xmlrpc.limits import ALL_LEASES, FLAG, SHORT_REPLY, Limits
from rosproxy.ros1.registry.remembered_leases import NAMESPACE, LeasesAtMaster
from rosproxy.shared.addresses import HostPort, parse_host_port
from rosproxy.shared.documents.status_bounds import fair_choice
from rosproxy.shared.machine.resolver import NODES, resolve
from rosproxy.shared.output.text import brief
from rosproxy.shared.uris import parse_inside_path, parse_service_uri, parse_slave_uri
from rosproxy.telemetry.metrics import Metrics

MOST_QUESTIONS = 32
"""Nodes asked at once; fewer than the look-ups of names (`rosproxy.shared.machine.resolver`)."""
MOST_TRIED = 1500
"""Nodes that the doctor tries at most, with fair shares for the hosts in their URIs. Any program
can register nodes at the master, and a node that does not answer takes ANSWER_TIMEOUT_S."""
MOST_REPORT_CHARACTERS = 32_000_000
"""Characters of the reports of all nodes at most. Each node has an equal part."""
MOST_PAGE_QUESTIONS = 4
"""Nodes asked at once for the live page, which asks repeatedly."""
ANSWER_TIMEOUT_S = 3.0
"""Seconds in which a node must answer."""
LONGEST_REASON = 200
"""Characters of the reason in an answer of a node or service."""

Key = TypeVar("Key")
Result = TypeVar("Result")


async def look_at_master(uri: str, instance: str, address: str | None) -> MasterFacts:
    """Ask the master, in the name of the proxy with this ``instance``.

    ``address``: the IP address to use instead of the host in ``uri``; None: resolve the host.
    """
    client = MasterClient(uri, instance, Metrics(), address)
    try:
        return await _Collector(client, client).master()
    finally:
        await client.close()


async def ask_graph(
    facts: DoctorFacts,
    uri: str,
    address: str | None = None,
    choose: Callable[[SystemState], tuple[str, ...]] | None = None,
) -> DoctorFacts:
    """Add the facts about the master and the nodes; without ``uri``, add nothing.

    ``address``: see `look_at_master`. ``choose``: picks the names to examine from the state of the
    master.

    The doctor calls the master in the name of the proxy's instance. So a proxy whose master URI
    leads to itself refuses the call as a loop. The doctor calls nodes in another name, since calls
    to nodes behind the proxy pass the proxy.
    """
    if not uri:
        return facts
    master, nodes = (
        MasterClient(uri, name, Metrics(), address) for name in (facts.proxy.instance, "doctor")
    )
    try:
        collector = _Collector(master, nodes, choose)
        published = await collector.published_master(facts)
        facts = replace(facts, master=await collector.master(), published_master=published)
        if facts.master and facts.master.attempt.reach is ReachOutcome.ANSWERED:
            with contextlib.suppress(Unreachable, MasterError):
                facts = await collector.master_state(facts)
    finally:
        await asyncio.gather(master.close(), nodes.close())
    return facts


class _Collector:
    """Asks the master and the nodes, with a bounded number of questions to nodes at once."""

    def __init__(
        self,
        master: MasterClient,
        nodes: MasterClient,
        choose: Callable[[SystemState], tuple[str, ...]] | None = None,
    ) -> None:
        self._master = master
        self._nodes = nodes
        self._choose = choose
        # For the live page, the proxy itself looks names up: those of nodes have a bound there.
        self._source = NODES if choose else ""
        self._limit = asyncio.Semaphore(MOST_PAGE_QUESTIONS if choose else MOST_QUESTIONS)

    async def master(self) -> MasterFacts:
        """Examine the master: host name, answer, path, and whether the URI leads to the proxy."""
        uri = self._master.master_uri
        addresses = tuple(await self._master.master_addresses())
        if not addresses:
            return MasterFacts(uri, Attempt(ReachOutcome.UNRESOLVABLE))
        started = time.monotonic()
        attempt, _ = await _attempt(self._master.call_master("getPid"))
        trip = time.monotonic() - started
        # The words of a proxy that has received its own call (`MasterApi._refuse_loop`).
        looped = "leads back to the proxy" in attempt.reason
        master = MasterFacts(uri, attempt, addresses, is_this_proxy=looped, round_trip=trip)
        # rosmaster answers only at / and /RPC2 (xmlrpc.server, rpc_paths). At another path the
        # answer is HTTP 404, as if no master ran there.
        root = parse_slave_uri(uri)
        if attempt.reach is ReachOutcome.STRANGER and root and urlsplit(uri).path not in ("", "/"):
            at_root = await self._ask_pid(root)
            master = replace(master, at_root=at_root.reach is ReachOutcome.ANSWERED)
        return master

    async def published_master(self, facts: DoctorFacts) -> Attempt:
        """Try the master at the advertised host and the port of ``--publish-master``, if set."""
        port = facts.proxy.settings.publish_master
        return await self._ask_pid(HostPort(facts.advertise_host, port)) if port else Attempt()

    async def master_state(self, facts: DoctorFacts) -> DoctorFacts:
        """Add the graph, and which nodes answer; examine the names in the user's question.

        Raises Unreachable, MasterError.
        """
        graph = system_state(await self._master.call_master("getSystemState"))
        names = sorted(graph.names())
        uris = await self._master.look_up("lookupNode", names)
        leases = await self._parameter(NAMESPACE, ALL_LEASES)
        # In a thread: a long parameter would hold up the proxy, which asks for the live page.
        nodes = await asyncio.to_thread(_all_node_facts, names, uris, leases)
        facts = replace(
            facts,
            graph=graph,
            uses_simulated_time=await self._simulated_time(),
            service_uris=await self._master.look_up("lookupService", graph.services),
        )
        wanted = facts.scope.nodes if facts.names else names
        to_try = _fair_part(nodes, wanted)
        nodes |= await _gather(to_try, lambda name: self._try_node(facts, nodes[name]))
        facts = replace(facts, nodes=nodes, untried=len(wanted) - len(to_try))
        if self._choose:
            facts = replace(facts, names=self._choose(graph))
        return await self._examine_named(facts) if facts.names else facts

    async def _examine_named(self, facts: DoctorFacts) -> DoctorFacts:
        """Add the answers of the nodes, pairs and services in the scope."""
        scope = facts.scope
        nodes = facts.nodes
        topics = {topic for topic, *_ in scope.pairs}
        to_ask = _fair_part(nodes, scope.nodes)
        most = MOST_REPORT_CHARACTERS // max(len(to_ask), 1)
        asked_nodes = await _gather(
            to_ask, lambda name: self._ask_node(facts, nodes[name], topics, most)
        )
        facts = replace(facts, nodes={**nodes, **asked_nodes})
        unconnected = {
            (publisher, topic)
            for topic, publisher, subscriber in scope.pairs
            if not is_connected(topic, facts.nodes[publisher], facts.nodes[subscriber])
        }
        return replace(
            facts,
            data_ports=await _gather(unconnected, lambda pair: self._try_data_port(facts, *pair)),
            services=await _gather(scope.services, lambda name: self._try_service(facts, name)),
        )

    async def _simulated_time(self) -> bool:
        # A boolean arrives as text. The parameter may also be a text or a number.
        return await self._parameter("/use_sim_time", FLAG) in ("1", "true", 1)

    async def _parameter(self, name: str, limits: Limits) -> Any:
        """The value of a parameter; None if not set, or if longer than ``limits``."""
        _, value = await _attempt(self._master.call_master("getParam", name, limits=limits))
        return value

    async def _try_node(self, facts: DoctorFacts, node: NodeFacts) -> NodeFacts:
        """Try a node at its address; the proxy itself knows whether a node behind it answers.

        If a node has a port of this proxy, but the proxy has no such node, the node may be behind
        another proxy with the same advertised host and range. Then the doctor tries that port, and
        the inside address of the node.
        """
        slave = node.slave
        if slave is None or facts.lease(slave):
            return node
        if facts.is_ours(slave):
            async with self._limit:
                attempts = [await self._ask_pid(s) for s in (slave, node.inside) if s]
            answered = next((a for a in attempts if a.reach is ReachOutcome.ANSWERED), None)
            return replace(node, attempt=answered) if answered else node
        async with self._limit:
            addresses = tuple(await resolve(self._nodes.reach(slave).host, self._source))
            attempt = (
                await self._ask_pid(slave) if addresses else Attempt(ReachOutcome.UNRESOLVABLE)
            )
        return replace(node, addresses=addresses, attempt=attempt)

    async def _ask_pid(self, target: HostPort) -> Attempt:
        question = self._nodes.call_node(target, ANSWER_TIMEOUT_S, "getPid", limits=SHORT_REPLY)
        attempt, pid = await _attempt(question)
        if attempt.failed or isinstance(pid, int):
            return attempt
        return Attempt(ReachOutcome.STRANGER, "the answer is not that of a node")

    async def _ask_node(
        self, facts: DoctorFacts, node: NodeFacts, topics: Collection[str], most: int
    ) -> NodeFacts:
        """Add the report of a node about ``topics``, unless it has more than ``most`` characters.

        The doctor asks a node behind the proxy through the proxy.
        """
        slave = _reached_at(facts, node.slave)
        ask = self._nodes.call_node
        if slave is None or node.attempt.failed:
            return node
        methods = ("getPublications", "getSubscriptions", "getBusInfo")
        try:
            async with self._limit:
                pubs, subs, bus = [await ask(slave, ANSWER_TIMEOUT_S, method) for method in methods]
                at = time.monotonic()
                # Last: some client libraries do not answer getBusStats.
                _, stats = await _attempt(ask(slave, ANSWER_TIMEOUT_S, "getBusStats"))
        except (Unreachable, MasterError):
            return node
        report = slave_report(pubs, subs, bus, stats, at, topics)
        return replace(node, report=report) if report.characters <= most else node

    async def _try_data_port(
        self, facts: DoctorFacts, publisher: str, topic: str
    ) -> tuple[str, Attempt]:
        """The TCPROS address of a publisher for a topic, and the attempt to connect.

        The address is empty if the publisher gives none. The attempt is UNTRIED for a publisher
        behind this proxy, and for a publisher that has sent no report.
        """
        node = facts.nodes[publisher]
        slave = _reached_at(facts, node.slave)
        if slave is None or node.report is None:
            return "", Attempt()
        attempt, answer = await _attempt(
            self._nodes.call_node(
                slave,
                ANSWER_TIMEOUT_S,
                "requestTopic",
                topic,
                [["TCPROS"]],
                limits=SHORT_REPLY,
            )
        )
        target = data_port(answer)
        if attempt.failed:
            return "", attempt
        if target is None:
            return "", Attempt(ReachOutcome.STRANGER, "no TCPROS address")
        # The port belongs to the proxy, and the try of the range covers the port. From here, NAT
        # without hairpin may block the port.
        if facts.is_ours(node.slave):
            return str(target), Attempt()
        # "*" matches any type (roscpp Publication::validateHeader; rospy tcpros_pubsub.py,
        # topic_connection_handler). This only tries the connection; a rule compares the types.
        header = {"callerid": CALLER_ID, "topic": topic, "type": "*", "md5sum": "*"}
        return str(target), await _shake_hands(self._nodes.reach(target), header, self._source)

    async def _try_service(self, facts: DoctorFacts, service: str) -> Attempt:
        """Ask a service for its type, as rosservice does."""
        provider = parse_service_uri(facts.service_uris.get(service, ""))
        if provider is None:
            return Attempt(ReachOutcome.STRANGER, "no address")
        target = _reached_at(facts, provider)
        if target is None:
            return Attempt(ReachOutcome.REFUSED, "no node holds its port")
        header = {"callerid": CALLER_ID, "service": service, "md5sum": "*", "probe": "1"}
        return await _shake_hands(self._nodes.reach(target), header, self._source)


def _reached_at(facts: DoctorFacts, target: HostPort | None) -> HostPort | None:
    """The address at which the doctor asks a node or service.

    For a node behind this proxy: the listen port at the proxy itself, which avoids the NAT of the
    host. None if no node holds that port.
    """
    if not facts.is_ours(target):
        return target
    lease = facts.lease(target)
    admin = parse_host_port(facts.admin.removeprefix("http://"))
    if lease is None or admin is None:
        return None
    bound = facts.proxy.settings.bind
    return HostPort(admin.host if bound in ("0.0.0.0", "::") else bound, lease.port)


async def _shake_hands(target: HostPort, header: Mapping[str, str], source: str) -> Attempt:
    """Try a TCPROS address by an exchange of connection headers; ``source``: see `resolve`."""
    addresses = await resolve(target.host, source)
    if not addresses:
        return Attempt(ReachOutcome.UNRESOLVABLE)
    try:
        async with asyncio.timeout(ANSWER_TIMEOUT_S):
            reply = await _exchange(HostPort(addresses[0], target.port), header)
    except (ConnectionError, EOFError):
        return Attempt(ReachOutcome.REFUSED)
    except OSError:
        return Attempt(ReachOutcome.SILENT)
    except HeaderError as error:
        return Attempt(ReachOutcome.STRANGER, str(error))
    return (
        Attempt(ReachOutcome.STRANGER, brief(reply["error"], LONGEST_REASON))
        if "error" in reply
        else Attempt(ReachOutcome.ANSWERED)
    )


async def _exchange(target: HostPort, header: Mapping[str, str]) -> dict[str, str]:
    reader, writer = await asyncio.open_connection(target.host, target.port)
    try:
        writer.write(encode_header(header))
        length = header_length(await reader.readexactly(4))
        return decode_header(await reader.readexactly(length))
    finally:
        writer.close()


def _all_node_facts(
    names: Iterable[str], uris: Mapping[str, str], leases: object
) -> dict[str, NodeFacts]:
    """The facts about all nodes at the master, by name; ``leases`` is the value of NAMESPACE."""
    at_master = LeasesAtMaster(leases)
    return {name: _node_facts(name, uris.get(name, ""), at_master) for name in names}


def _node_facts(name: str, uri: str, leases: LeasesAtMaster) -> NodeFacts:
    """The facts about a node at the master."""
    slave = parse_slave_uri(uri)
    lease = leases.at(slave) if slave else None
    inside = parse_inside_path(uri) or (lease.node if lease else None)
    return NodeFacts(name, uri, inside.slave if inside else None)


async def _attempt(question: Awaitable[Any]) -> tuple[Attempt, Any]:
    """How a question ended, and the answer. The answer is None if the question failed."""
    try:
        return Attempt(ReachOutcome.ANSWERED), await question
    except (Unreachable, MasterError) as error:
        if isinstance(error, Unreachable) and error.refused:
            return Attempt(ReachOutcome.REFUSED), None
        # Without the name of the node or master at the beginning: the finding names the object.
        reason = str(error).partition("\n")[0].partition(": ")[2][:LONGEST_REASON]
        cause = error.__cause__
        # A program that ends the connection is there. Otherwise there may be no machine, or no way.
        if isinstance(cause, OSError) and not isinstance(cause, ConnectionError):
            return Attempt(ReachOutcome.SILENT, reason), None
        return Attempt(ReachOutcome.STRANGER, reason or "the answer can't be read"), None


def _fair_part(nodes: Mapping[str, NodeFacts], names: Iterable[str]) -> list[str]:
    """MOST_TRIED names of nodes, with fair shares for the hosts in their URIs."""

    def host(name: str) -> str:
        slave = nodes[name].slave
        return slave.host if slave else ""

    return fair_choice(names, host, MOST_TRIED)


async def _gather(
    keys: Iterable[Key], work: Callable[[Key], Awaitable[Result]]
) -> dict[Key, Result]:
    """The results of ``work`` for each key, for MOST_QUESTIONS keys at a time."""
    waiting = iter(wanted := list(keys))
    results: dict[Key, Result] = {}

    async def work_in_order() -> None:
        for key in waiting:
            results[key] = await work(key)

    await asyncio.gather(*(work_in_order() for _ in range(MOST_QUESTIONS)))
    return {key: results[key] for key in wanted}
