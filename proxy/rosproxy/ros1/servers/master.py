"""The master port: inside nodes call it as their master."""

import logging
from dataclasses import replace

from rosproxy.net.http_server import Call
from rosproxy.ros1.alias import policy
from rosproxy.ros1.alias.alias import Alias
from rosproxy.ros1.clients.master import Unreachable
from rosproxy.ros1.context import Context
from rosproxy.ros1.protocol.xmlrpc import document as xmlrpc
from rosproxy.ros1.registry.endpoint import Endpoint
from rosproxy.ros1.registry.leases import Leases
from rosproxy.ros1.rewriting import master_api
from rosproxy.ros1.rewriting.addressing import Asker
from rosproxy.ros1.rewriting.master_api import Answer, Request
from rosproxy.ros1.upkeep.adoption.adopter import Adopter
from rosproxy.ros1.upkeep.recovery.recovery import Recovery

log = logging.getLogger(__name__)


class MasterApi:
    """Forwards master API calls, rewritten, and keeps the registry in step with the master.

    Calls that register wait for the ``recovery``: a node that registered before would get
    another port, and the master would shut it down for having moved.
    """

    def __init__(
        self,
        context: Context,
        leases: Leases,
        alias: Alias,
        recovery: Recovery,
        adopter: Adopter,
    ) -> None:
        self._context, self._leases, self._alias = context, leases, alias
        self._recovery, self._adopter = recovery, adopter

    async def __call__(self, call: Call) -> bytes:
        """The reply to a call. Raises XmlRpcError, Unreachable."""
        self._refuse_loop(call)
        asker = Asker(call.source, call.local.host, master=call.host_header or str(call.local))
        try:
            request = master_api.read_request(call.body, asker)
        except xmlrpc.XmlRpcError:
            self._context.metrics.count("master", "other", "malformed")
            raise
        try:
            reply = await self._reply(request)
        except Unreachable:
            self._context.metrics.count("master", request.method, "unreachable")
            raise
        self._context.metrics.count("master", request.method, "answered")
        return reply

    async def _reply(self, request: Request) -> bytes:
        if request.plain:
            return await self._context.upstream.post_to_master(request.body)
        await self._recovery.ensure()
        self._context.refresh_networks(request.asker.address)
        pending: list[Endpoint] = []
        try:
            for call in request.calls:  # one after the other: they may register the same new node
                admission = await self._leases.admit(call, request.asker) if call else None
                request.admissions.append(admission)
                if isinstance(admission, Endpoint):
                    pending.append(admission)
                    await self._adopter.take_over(admission, call.string(0) or "" if call else "")
            return await self._forward(request)
        finally:
            for endpoint in pending:
                endpoint.pending -= 1

    async def _forward(self, request: Request) -> bytes:
        local = master_api.local_reply(request)
        if local is not None:
            return local
        body = master_api.export_request(request, self._context.addressing)
        reply = await self._context.upstream.post_to_master(body)
        answer = master_api.read_answer(request, reply)
        self._note(answer, request.asker)
        await self._alias.listen_for(policy.uris_in_answer(answer))
        return master_api.import_answer(request, answer, self._context.addressing)

    def _note(self, answer: Answer, asker: Asker) -> None:
        """Take in what the master accepted.

        A service's port is believed only from the node's own address: anybody may register a
        service in another node's name, and its port would be opened to outside.
        """
        registry, now = self._context.registry, self._context.now()
        for fact in master_api.noted(answer, now):
            held = fact.registration
            if fact.endpoint is None:
                registry.unregister(held.kind, held.name, held.caller_id)
            elif registry.by_port.get(fact.endpoint.port) is fact.endpoint:
                own = asker.address == fact.endpoint.place.address
                registry.register(fact.endpoint, held if own else replace(held, service_api=None))

    def _refuse_loop(self, call: Call) -> None:
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

    async def __call__(self, call: Call) -> bytes:
        """The master's reply to a call. Raises XmlRpcError, Unreachable."""
        asker = Asker(call.source, call.local.host, master=self._address)
        request = master_api.read_request(call.body, asker)
        request.admissions = [None] * len(request.calls)
        reply = await self._context.upstream.post_to_master(call.body)
        if not any(inner and inner.method == "getUri" for inner in request.calls):
            return reply
        answer = master_api.read_answer(request, reply)
        return master_api.rename_master(answer, self._address)
