"""The master port: inside nodes call it as their master.

A call that registers or names an address goes one way: its node is admitted (`admission`), its
addresses are exported, the master is called, what it accepted is noted in the registry, and the
addresses in the reply are imported (`rosproxy.ros1.rewriting.master_api`). All other calls pass as
they are.
"""

from dataclasses import replace

from rosproxy.ros1.clients.master import Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.rewriting import master_api
from rosproxy.ros1.rewriting.addressing import Asker
from rosproxy.ros1.rewriting.master_api import MasterReply, Request
from rosproxy.ros1.servers.admission import NodeAdmission
from rosproxy.ros1.servers.needs import AliasPorts, Recovering, TakingOver
from rosproxy.ros1.servers.xmlrpc_server import IncomingCall


class MasterApi:
    """Forwards master API calls, rewritten, and keeps the registry in step with the master.

    Calls that register wait for the ``recovery``: a node that registered before would get
    another port, and the master would shut it down for having moved.
    """

    def __init__(
        self,
        context: Context,
        admission: NodeAdmission,
        alias: AliasPorts,
        recovery: Recovering,
        adopter: TakingOver,
    ) -> None:
        self._context, self._admission, self._alias = context, admission, alias
        self._recovery, self._adopter = recovery, adopter

    async def __call__(self, call: IncomingCall) -> bytes:
        """The reply to a call. Raises XmlRpcError, Unreachable."""
        self._refuse_loop(call)
        asker = Asker(call.source, call.local.host, master=call.host_header or str(call.local))
        count = self._context.metrics.count
        try:
            request = master_api.read_request(call.body, asker)
        except xmlrpc.XmlRpcError:
            count("master", "other", "malformed")
            raise
        try:
            if request.plain:
                reply = await self._context.upstream.post_to_master(request.body)
            else:
                reply = await self._rewrite(request)
        except Unreachable:
            count("master", request.method, "unreachable")
            raise
        count("master", request.method, "answered")
        return reply

    async def _rewrite(self, request: Request) -> bytes:
        """Admit, export, call the master, note, import."""
        await self._recovery.ensure()
        addressing = self._context.addressing
        async with self._admission.of(request, self._adopter) as admissions:
            exported = master_api.export_request(request, admissions, addressing)
            if exported.body is None:
                return exported.refused_reply()
            answer = await self._context.upstream.post_to_master(exported.body)
            reply = master_api.read_reply(exported, answer)
            self._note(reply, request.asker.address)
            await self._alias.listen_for(reply.uris())
            return master_api.import_reply(reply, addressing)

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

    def _refuse_loop(self, call: IncomingCall) -> None:
        if not call.comes_from(self._context.instance):
            return
        what = "a node's address"
        if call.loop_id == self._context.instance:
            what = f"--master-uri {self._context.settings.master_uri}"
        raise xmlrpc.XmlRpcError(xmlrpc.SYSTEM_ERROR, f"{what} leads back to the proxy itself")


class PublishedMaster:
    """The master itself for outside (``--publish-master``), where it runs inside.

    What the master holds are outside addresses already; only its own URI is replaced.
    """

    def __init__(self, context: Context, address: str) -> None:
        self._context, self._address = context, address

    async def __call__(self, call: IncomingCall) -> bytes:
        """The master's reply to a call. Raises XmlRpcError, Unreachable."""
        asker = Asker(call.source, call.local.host, master=self._address)
        request = master_api.read_request(call.body, asker)
        reply = await self._context.upstream.post_to_master(call.body)
        return master_api.rename_master(request, reply, self._address)
