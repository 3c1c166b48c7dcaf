"""Wires a new pod to the proxy of the node, before the API server creates the pod.

kopf calls the injector for each pod with the label rosproxy.io/inject (`serving`). The injector
reads the RosProxies of the namespace and the RosProxy's Service from the API server. The planner
chooses the RosProxy and the variables. If a user creates the pod together with the RosProxy, the
Service may be missing. Then the injector wakes the operator, and the pod waits.

The injector writes nothing. The Service is created by the plan of a look, which knows the former
address, the owner and the retries. The injector admits the pod in every case. If the pod is not
wired, a warning gives the problem and the fix.
"""

import asyncio
import logging
import time
from collections.abc import Callable
from datetime import datetime

from rosproxy_operator.common.operator_metrics import ClusterMetrics
from rosproxy_operator.common.problem import with_fix
from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.kubernetes.api.api_client import (
    SOON,
    Api,
    ApiError,
    ApiNotFound,
    ApiUnavailable,
)
from rosproxy_operator.kubernetes.planner.bounds import Consents, bounds_violation
from rosproxy_operator.kubernetes.planner.pods.selection import select_rosproxy, why_not_selected
from rosproxy_operator.kubernetes.planner.pods.wiring import Wiring, left_alone, pod_variables, wire
from rosproxy_operator.kubernetes.resources import objects
from rosproxy_operator.kubernetes.resources.model import Json, RosProxy
from rosproxy_operator.kubernetes.resources.names import service_id
from rosproxy_operator.kubernetes.resources.spec import rosproxies
from rosproxy_operator.kubernetes.settings import ClusterSettings
from rosproxy_operator.kubernetes.status.refusal_fixes import NOT_OURS

log = logging.getLogger(__name__)

ADMISSION_TIMEOUT_S = 4.0
"""Seconds until the injector admits a pod unwired.

The API server must wait longer for the webhook (timeoutSeconds, 5 s by default in the chart).
"""
RETRY_INTERVAL_S = 0.2
"""Seconds between tries while the API server does not answer, or the Service is missing."""
YOUNG_SERVICE_S = 3.0
"""Seconds after the creation of a Service in which some nodes may not know the Service.

kube-proxy gathers changes for 1 s, and a creationTimestamp has whole seconds. If a pod connects too
early, conntrack notes a connection without translation. The packets of the connection are then lost
for two minutes, even if kube-proxy knows the Service a moment later. So the injector holds the pod.
"""


class NotWired(Exception):
    """The injector can't wire the pod. The message has the reason and the fix."""


class NoService(NotWired):
    """The injector can't wire the pod yet: the operator has not created the Service."""


class Injector:
    """Wires pods. ``wake`` makes the operator look at the cluster soon."""

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
        """The wiring of a pod, or a warning after an error. A ``dry_run`` waits for no Service."""
        deadline = time.monotonic() + ADMISSION_TIMEOUT_S
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
        return left_alone(text)

    async def _wiring_by(self, body: Json, dry_run: bool, deadline: float) -> tuple[Wiring, float]:
        """The wiring of a pod, and the seconds to hold the pod.

        Tries until the deadline, because an API server may be starting, or the Service may be
        missing. Raises ApiError, NotWired.
        """
        timeout_text = (
            f"the API server did not answer within {ADMISSION_TIMEOUT_S:g} s. Create the pod again"
        )
        while True:
            try:
                async with asyncio.timeout(deadline - time.monotonic()):
                    return await in_thread(self._wiring, body, dry_run)
            except ApiUnavailable as error:
                log.debug("pod not wired yet, the operator tries again: %s", error)
            except NoService as error:
                if dry_run:
                    raise
                timeout_text = str(error)
                self._wake()
            except TimeoutError:
                raise NotWired(timeout_text) from None
            await asyncio.sleep(RETRY_INTERVAL_S)

    def _wiring(self, body: Json, dry_run: bool) -> tuple[Wiring, float]:
        """The wiring of a pod, and the seconds to hold the pod. Raises ApiError, NotWired."""
        pod = objects.pod(body)
        namespace = pod.id.namespace
        # Without a namespace, the API server would list the RosProxies of all namespaces. An API
        # server fills in the namespace of each pod (k8s.io/apiserver,
        # EnsureObjectNamespaceMatchesRequestNamespace), but any client may call the webhook.
        listed = self._api.rosproxies(namespace, SOON) if namespace else []
        readable, unusable = rosproxies(listed)
        usable = [r for r in readable.values() if not r.deleting]
        rosproxy = select_rosproxy(pod, usable)
        if isinstance(rosproxy, RosProxy):
            address, hold = self._address(rosproxy, dry_run)
            return wire(body, pod_variables(rosproxy, address), rosproxy.spec.host_aliases), hold
        if rosproxy is not None:
            return left_alone(rosproxy.text, rosproxy.message), 0.0
        fault = why_not_selected(pod, usable)
        if not fault:
            return Wiring(), 0.0
        reasons = [f"RosProxy {r.id.name}: {with_fix(r.text, r.fix)}" for r in unusable.values()]
        return left_alone(fault.text, ". ".join([str(fault), *reasons])), 0.0

    def _address(self, rosproxy: RosProxy, dry_run: bool) -> tuple[str, float]:
        """The cluster IP of a RosProxy's Service, and the seconds until all nodes know the Service.

        Raises ApiError, NotWired.
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
            text = f"a Service {id} exists already that {NOT_OURS}. Delete that Service, or use"
            raise NotWired(f"{text} another name for the RosProxy")
        if service.owner != rosproxy.uid or service.deleting or not service.cluster_ip:
            raise self._missing(rosproxy)
        if dry_run:
            return service.cluster_ip, 0.0
        # Bounded, because the clocks of the API server and of this machine may differ.
        created_at = datetime.fromisoformat(manifest["metadata"]["creationTimestamp"]).timestamp()
        return service.cluster_ip, min(
            max(created_at + YOUNG_SERVICE_S - time.time(), 0.0), YOUNG_SERVICE_S
        )

    def _missing(self, rosproxy: RosProxy) -> NotWired:
        """The error for a RosProxy without a usable Service.

        NotWired if the RosProxy asks for more than the administrator allows. Else NoService: the
        operator is about to create the Service, and the pod waits.
        """
        if refused := bounds_violation(rosproxy, self._consents(rosproxy), self._settings):
            return NotWired(f"RosProxy {rosproxy.id.name}: {refused}. Then create the pod again")
        id = service_id(rosproxy.id)
        return NoService(
            f"the Service {id} has no cluster IP yet. Read kubectl -n {id.namespace} describe "
            f"rosproxy {rosproxy.id.name}. When the Service has a cluster IP, create the pod again"
        )

    def _consents(self, rosproxy: RosProxy) -> Consents:
        """The other namespaces whose RosProxies may name the Service of this RosProxy's master."""
        service = rosproxy.spec.master.service
        if service is None:
            return {}
        try:
            return {service: objects.allowed_from(self._api.get("services", service, SOON))}
        except ApiNotFound:
            return {}
