"""The master port: inside nodes call it as their master.

A call that registers or names an address goes one way: its node is admitted (`admission`), its
addresses are exported, the master is called, what it accepted is noted in the registry, and the
addresses in the reply are imported (`rosproxy.ros1.rewriting.master_api`). All other calls pass as
they are.
"""

import logging
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace

from rosproxy.ros1.alias.alias import Alias
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.bounds import too_long_to_register
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.protocol.xmlrpc.document import Call
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.rewriting import master_api
from rosproxy.ros1.rewriting.addressing import Asker
from rosproxy.ros1.rewriting.master_api import Admission, MasterReply, Refusal, Request
from rosproxy.ros1.servers.admission import NodeAdmission
from rosproxy.ros1.servers.xmlrpc_server import IncomingCall, counted
from rosproxy.ros1.upkeep.adopter import Adopter
from rosproxy.ros1.upkeep.recovery import Recovery

log = logging.getLogger(__name__)


@dataclass(slots=True, eq=False)
class MasterApi:
    """Forwards master API calls, rewritten, and keeps the registry in step with the master."""

    _context: Context
    _admission: NodeAdmission
    _alias: Alias
    _recovery: Recovery
    _adopter: Adopter

    async def __call__(self, call: IncomingCall) -> bytes:
        """The reply to a call. Raises XmlRpcError, Unreachable."""
        if call.comes_from(self._context.instance):
            what = "a node's address"
            if call.loop_id == self._context.instance:
                what = f"--master-uri {self._context.settings.master_uri}"
            raise xmlrpc.XmlRpcError(xmlrpc.SYSTEM_ERROR, f"{what} leads back to the proxy itself")
        asker = Asker(call.source, call.local.host, master=call.host_header or str(call.local))
        metrics = self._context.metrics
        try:
            request = master_api.read_request(call.body, asker)
        except xmlrpc.XmlRpcError:
            metrics.count("master", "other", "malformed")
            raise
        if request.plain:
            reply = self._context.upstream.post_to_master(request.body)
        else:
            reply = self._rewrite(request)
        return await counted(metrics, "master", request.method, reply)

    async def _rewrite(self, request: Request) -> bytes:
        """Admit, export, call the master, note, import."""
        await self._recovery.ensure()
        addressing = self._context.addressing
        async with self._admitted(request) as admissions:
            exported = master_api.export_request(request, admissions, addressing)
            if exported.body is None:
                return exported.refused_reply()
            answer = await self._context.upstream.post_to_master(exported.body)
            reply = master_api.read_reply(exported, answer)
            self._note(reply, request.asker.address)
            await self._alias.listen_for(reply.uris())
            return master_api.import_reply(reply, addressing)

    @asynccontextmanager
    async def _admitted(self, request: Request) -> AsyncIterator[Sequence[Admission]]:
        """What becomes of each call of a request. Raises Unreachable.

        Within the context their endpoints are *pending*: their leases do not end while the calls
        are on their way.
        """
        self._context.refresh_networks(request.asker.address)
        admissions: list[Admission] = []
        try:
            for call in request.calls:  # one after the other: they may register the same new node
                admission = await self._admit(call, request.asker) if call else None
                admissions.append(admission)
                if isinstance(admission, Endpoint):
                    admission.hold()
                    await self._adopter.take_over(admission, call.string(0) or "" if call else "")
            yield admissions
        finally:
            for admission in admissions:
                if isinstance(admission, Endpoint):
                    admission.release()

    async def _admit(self, call: Call, asker: Asker) -> Admission:
        """What becomes of one call; what is too long, or one too many, is refused."""
        if text := too_long_to_register(call):
            return self._refuse("long_name", call, asker, text)
        admission = await self._admission.admit(call, asker)
        if isinstance(admission, Endpoint) and (text := admission.full):
            return self._refuse("too_many_names", call, asker, text)
        return admission

    def _refuse(self, reason: str, call: Call, asker: Asker, text: str) -> Refusal:
        """Refuse a call that is over a bound, and tell of it: of the last one for each reason."""
        self._context.metrics.refused.labels(reason).inc()
        subject = f"refused: {reason.replace('_', ' ')}"
        self._context.problems.solved(subject)
        self._context.problems.add(subject, f"from {asker.address}: {text}")
        log.warning(
            "%s: %s of %s is refused: %s", asker.address, call.method, asker.caller_id, text
        )
        return Refusal(f"rosproxy: {text}")

    def _note(self, reply: MasterReply, source: str) -> None:
        """Take in what the master accepted.

        A service's port is believed only from the node's own address: anybody may register a
        service in another node's name, and its port would be opened to outside.
        """
        registry = self._context.registry
        for fact in reply.facts(self._context.now()):
            held = fact.registration
            if fact.endpoint is None:
                registry.unregister(held.kind, held.name, held.caller_id)
            elif registry.by_port.get(fact.endpoint.port) is fact.endpoint:
                own = source == fact.endpoint.place.address
                registry.register(fact.endpoint, held if own else replace(held, service_api=None))


async def serve_published(context: Context, address: str, call: IncomingCall) -> bytes:
    """The master itself for outside (``--publish-master``), where it runs inside.

    What the master holds are outside addresses already; only its own URI is replaced. Raises
    XmlRpcError, Unreachable.
    """
    asker = Asker(call.source, call.local.host, master=address)
    request = master_api.read_request(call.body, asker)
    reply = await context.upstream.post_to_master(call.body)
    return master_api.rename_master(request, reply, address)
