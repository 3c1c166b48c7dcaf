"""Wires a pod, as the API server is about to create it, to the proxy of its node.

A pod with the label rosproxy.io/inject comes here from kopf (`watch`). The RosProxies of its
namespace and their Service are read as they are at this moment; the planner says which RosProxy
takes the pod and what it needs. Nothing is written: the Service is the operator's alone to make,
which knows its address, its owner and what to do when it is refused. Where it is not there yet,
since pod and RosProxy were created together, the operator is woken and the pod waits. Whatever
goes wrong, the pod is admitted; a warning says what is amiss and what to do.
"""

import asyncio
import logging
import time
from collections.abc import Callable
from datetime import datetime

from rosproxy_operator.common.metrics import ClusterMetrics
from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.kubernetes.api.client import SOON, Api, ApiAway, ApiError, ApiGone
from rosproxy_operator.kubernetes.planner.access.bounds import Consents, objection
from rosproxy_operator.kubernetes.planner.pods.injection import Wiring, target_of, wire
from rosproxy_operator.kubernetes.planner.pods.selection import chosen, nobody
from rosproxy_operator.kubernetes.resources import objects
from rosproxy_operator.kubernetes.resources.model import Json, RosProxy
from rosproxy_operator.kubernetes.resources.names import service_id
from rosproxy_operator.kubernetes.resources.spec import rosproxies
from rosproxy_operator.kubernetes.settings import ClusterSettings

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
    """A pod can't be wired; the message says why and what to do."""


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
        self._api, self._settings = api, settings
        self._metrics, self._wake = metrics, wake

    async def wiring(self, body: Json, dry_run: bool) -> Wiring:
        """What a pod needs. Never raises. A ``dry_run`` does not wait for a Service."""
        until = time.monotonic() + LONGEST
        try:
            found, hold = await self._patiently(body, dry_run, until)
            await asyncio.sleep(min(hold, until - time.monotonic()))
            self._metrics.admissions.labels("wired" if found.spec is not None else "left").inc()
            return found
        except (ApiError, NotWired) as error:
            text = str(error)
        except Exception as error:
            log.exception("a pod could not be wired")
            text = f"the operator failed: {error!r}"
        self._metrics.admissions.labels("failed").inc()
        log.warning("a pod at admission: %s", text)
        return Wiring(warnings=(NOT_WIRED + text,))

    async def _patiently(self, body: Json, dry_run: bool, until: float) -> tuple[Wiring, float]:
        """What a pod needs, and how long to wait then.

        Also from an API server that is just starting, and before the Service is there.
        """
        missing = f"the API server did not answer within {LONGEST:g} s; create the pod anew"
        while True:
            try:
                async with asyncio.timeout(until - time.monotonic()):
                    return await in_thread(self._wiring, body, dry_run)
            except ApiAway as error:
                log.debug("a pod at admission: %s; trying again", error)
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
        found, unusable = rosproxies(self._api.rosproxies(pod.id.namespace, SOON))
        usable = [each for each in found.values() if not each.deleting]
        of = chosen(pod, usable)
        if isinstance(of, RosProxy):
            address, hold = self._address(of, dry_run)
            return wire(body, target_of(of, address), of.spec.host_aliases), hold
        if of is not None:
            return Wiring(warnings=(NOT_WIRED + of.text,)), 0.0
        text = nobody(pod, usable)
        why = [f"RosProxy {one.id.name}: {one.text}" for one in unusable.values()]
        return Wiring(warnings=("; ".join([NOT_WIRED + text, *why]),) if text else ()), 0.0

    def _address(self, of: RosProxy, dry_run: bool) -> tuple[str, float]:
        """The cluster IP of a RosProxy's Service, and in how many seconds it works everywhere.

        Raises NotWired.
        """
        id = service_id(of.id)
        try:
            there = self._api.get("services", id, SOON)
        except ApiGone:
            if dry_run and of.cluster_ip:
                return of.cluster_ip, 0.0
            raise self._missing(of) from None
        found = objects.service(there)
        if found is None:
            raise NotWired(f"the Service {id} is not the operator's: delete or rename it")
        if found.owner != of.uid or found.deleting or not found.cluster_ip:
            raise self._missing(of)
        if dry_run:
            return found.cluster_ip, 0.0
        made = datetime.fromisoformat(there["metadata"]["creationTimestamp"]).timestamp()
        return found.cluster_ip, min(max(made + YOUNG - time.time(), 0.0), YOUNG)

    def _missing(self, of: RosProxy) -> NotWired:
        """Why a RosProxy has no Service: it asks for more than it may, or the Service is to come.

        For one that is not to come no pod waits.
        """
        if refused := objection(of, self._consents(of), self._settings):
            return NotWired(f"RosProxy {of.id.name}: {refused}; create the pod anew then")
        id = service_id(of.id)
        return NoService(
            f"the Service {id} has no cluster IP yet: kubectl -n {id.namespace} describe rosproxy "
            f"{of.id.name} says why; create the pod anew then"
        )

    def _consents(self, of: RosProxy) -> Consents:
        """Whose RosProxies may name the Service that a RosProxy names as its master."""
        service = of.spec.master.service
        if service is None:
            return {}
        try:
            return {service: objects.allowed_from(self._api.get("services", service, SOON))}
        except ApiGone:
            return {}
