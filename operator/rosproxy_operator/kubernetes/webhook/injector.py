"""Wires a pod, as the API server is about to create it, to the proxy of its node.

A pod with the label rosproxy.io/inject comes here from kopf (`serving`). The RosProxies of its
namespace and their Service are read as they are at this moment; the planner says which RosProxy
takes the pod and what it needs. Nothing is written: the Service is the operator's alone to make,
which knows its address, its owner and what to do when it is refused. Where it is not there yet,
since pod and RosProxy were created together, the operator is woken and the pod waits. Whatever
goes wrong, the pod is admitted; a warning gives the problem and the fix.
"""

import asyncio
import logging
import time
from collections.abc import Callable
from datetime import datetime

from rosproxy_operator.common.operator_metrics import ClusterMetrics
from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.kubernetes.api.api_client import (
    SOON,
    Api,
    ApiError,
    ApiNotFound,
    ApiUnavailable,
)
from rosproxy_operator.kubernetes.planner.bounds import Consents, bounds_violation
from rosproxy_operator.kubernetes.planner.pods.injection import Wiring, target_of, wire
from rosproxy_operator.kubernetes.planner.pods.selection import select_rosproxy, why_not_selected
from rosproxy_operator.kubernetes.resources import objects
from rosproxy_operator.kubernetes.resources.model import Json, RosProxy
from rosproxy_operator.kubernetes.resources.names import service_id
from rosproxy_operator.kubernetes.resources.spec import rosproxies
from rosproxy_operator.kubernetes.settings import ClusterSettings
from rosproxy_operator.kubernetes.status.refusal_fixes import OF_ANOTHER

log = logging.getLogger(__name__)

LONGEST = 4.0
"""Seconds until a pod is admitted as it is: less than the API server waits for the webhook."""
AGAIN = 0.2
"""Seconds until the API server is asked again that did not answer, or has no Service yet."""
YOUNG = 3.0
"""Seconds for which a Service may not be known on all nodes (kube-proxy gathers changes for 1 s).

Its creationTimestamp has whole seconds, so up to one of these has passed already.
A pod that connects before loses its packets for two minutes, even if the Service is known a moment
later: the connection was tracked as one that is not translated. So its admission is held up.
"""
NOT_WIRED = "rosproxy: this pod was not wired to a proxy: "
"""How each warning at admission begins."""


class NotWired(Exception):
    """A pod can't be wired; the message has the reason and the fix."""


class NoService(NotWired):
    """It can't be wired yet: its RosProxy has no Service, which the operator is about to make."""


class Injector:
    """Wires pods. ``wake`` lets the operator look at the cluster soon."""

    def __init__(
        self,
        api: Api,
        settings: ClusterSettings,
        metrics: ClusterMetrics,
        wake: Callable[[], None],
    ) -> None:
        self._api = api
        self._settings = settings
        self._metrics = metrics
        self._wake = wake

    async def wiring(self, body: Json, dry_run: bool) -> Wiring:
        """What a pod needs. Never raises. A ``dry_run`` does not wait for a Service."""
        deadline = time.monotonic() + LONGEST
        try:
            wiring, hold = await self._wiring_by(body, dry_run, deadline)
            await asyncio.sleep(min(hold, deadline - time.monotonic()))
            self._metrics.admissions.labels("wired" if wiring.spec is not None else "left").inc()
            return wiring
        except (ApiError, NotWired) as error:
            text = str(error)
        except Exception as error:
            log.exception("pod not wired by an internal error")
            text = f"the operator failed: {error!r}"
        self._metrics.admissions.labels("failed").inc()
        log.warning("pod not wired: %s", text)
        return Wiring(warnings=(NOT_WIRED + text,))

    async def _wiring_by(self, body: Json, dry_run: bool, deadline: float) -> tuple[Wiring, float]:
        """What a pod needs, and for how many seconds to hold it up; tried until the deadline.

        For an API server may be just starting, or the Service not be there yet.
        """
        missing = f"the API server did not answer within {LONGEST:g} s. Create the pod again"
        while True:
            try:
                async with asyncio.timeout(deadline - time.monotonic()):
                    return await in_thread(self._wiring, body, dry_run)
            except ApiUnavailable as error:
                log.debug("pod not wired yet, the operator tries again: %s", error)
            except NoService as error:
                if dry_run:
                    raise
                missing = str(error)
                self._wake()
            except TimeoutError:
                raise NotWired(missing) from None
            await asyncio.sleep(AGAIN)

    def _wiring(self, body: Json, dry_run: bool) -> tuple[Wiring, float]:
        pod = objects.pod(body)
        namespace = pod.id.namespace
        # Without a namespace the API server would list the RosProxies of all. An API server names
        # one for each pod (k8s.io/apiserver, EnsureObjectNamespaceMatchesRequestNamespace), but any
        # pod can ask.
        listed = self._api.rosproxies(namespace, SOON) if namespace else []
        readable, unusable = rosproxies(listed)
        usable = [r for r in readable.values() if not r.deleting]
        rosproxy = select_rosproxy(pod, usable)
        if isinstance(rosproxy, RosProxy):
            address, hold = self._address(rosproxy, dry_run)
            return wire(body, target_of(rosproxy, address), rosproxy.spec.host_aliases), hold
        if rosproxy is not None:
            return Wiring(warnings=(NOT_WIRED + rosproxy.text,)), 0.0
        text = why_not_selected(pod, usable)
        reasons = [f"RosProxy {r.id.name}: {r.text}" for r in unusable.values()]
        return Wiring(warnings=(". ".join([NOT_WIRED + text, *reasons]),) if text else ()), 0.0

    def _address(self, rosproxy: RosProxy, dry_run: bool) -> tuple[str, float]:
        """The cluster IP of a RosProxy's Service, and in how many seconds it works everywhere.

        Raises NotWired.
        """
        id = service_id(rosproxy.id)
        try:
            manifest = self._api.get("services", id, SOON)
        except ApiNotFound:
            if dry_run and rosproxy.cluster_ip:
                return rosproxy.cluster_ip, 0.0
            raise self._missing(rosproxy) from None
        service = objects.service(manifest)
        if service is None:
            text = f"a Service {id} exists already that {OF_ANOTHER}. Delete that Service, or use"
            raise NotWired(f"{text} another name for the RosProxy")
        if service.owner != rosproxy.uid or service.deleting or not service.cluster_ip:
            raise self._missing(rosproxy)
        if dry_run:
            return service.cluster_ip, 0.0
        # Bounded, since the clocks of the API server and of this machine may differ.
        created_at = datetime.fromisoformat(manifest["metadata"]["creationTimestamp"]).timestamp()
        return service.cluster_ip, min(max(created_at + YOUNG - time.time(), 0.0), YOUNG)

    def _missing(self, rosproxy: RosProxy) -> NotWired:
        """Why a RosProxy has no Service: it asks for more than it may, or the Service is to come.

        Pods wait for the latter alone (NoService).
        """
        if refused := bounds_violation(rosproxy, self._consents(rosproxy), self._settings):
            return NotWired(f"RosProxy {rosproxy.id.name}: {refused}. Then create the pod again")
        id = service_id(rosproxy.id)
        return NoService(
            f"the Service {id} has no cluster IP yet. Read kubectl -n {id.namespace} describe "
            f"rosproxy {rosproxy.id.name}. When the Service has a cluster IP, create the pod again"
        )

    def _consents(self, rosproxy: RosProxy) -> Consents:
        """The namespaces whose RosProxies may name the Service that is this one's master."""
        service = rosproxy.spec.master.service
        if service is None:
            return {}
        try:
            return {service: objects.allowed_from(self._api.get("services", service, SOON))}
        except ApiNotFound:
            return {}
