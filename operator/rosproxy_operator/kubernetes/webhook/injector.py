"""A pod at admission: which RosProxy is its, and what it needs to find the proxy on its node.

Whatever goes wrong, the pod is admitted; a warning says what is amiss and what to do.
"""

import asyncio
import logging
import time
from datetime import datetime

from rosproxy_operator.common.metrics import ClusterMetrics
from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.kubernetes.api import SOON, Api, Found
from rosproxy_operator.kubernetes.apply import create_service
from rosproxy_operator.kubernetes.errors import ApiError, Kind
from rosproxy_operator.kubernetes.planner.injection import Wiring, wire
from rosproxy_operator.kubernetes.planner.manifests import service as service_body
from rosproxy_operator.kubernetes.planner.model import Json, Pod, RosProxy
from rosproxy_operator.kubernetes.planner.names import master_uri, service_id
from rosproxy_operator.kubernetes.planner.objects import pod as parse_pod
from rosproxy_operator.kubernetes.planner.objects import service as parse_service
from rosproxy_operator.kubernetes.planner.selection import chosen, nobody
from rosproxy_operator.kubernetes.planner.spec import Unusable, rosproxy

log = logging.getLogger(__name__)

LONGEST = 4.0
"""Seconds until a pod is admitted as it is: less than the API server waits for the webhook."""
AGAIN = 0.3
"""Seconds until an API server is asked again that did not answer."""
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


class Injector:
    """Wires pods, asking the API server for the RosProxies and the Service as they are now."""

    def __init__(self, api: Api, metrics: ClusterMetrics) -> None:
        self._api, self._metrics = api, metrics

    async def wiring(self, body: Json, dry_run: bool) -> Wiring:
        """What a pod needs. Never raises. On a ``dry_run`` nothing is created."""
        until = time.monotonic() + LONGEST
        try:
            async with asyncio.timeout(LONGEST):
                found, hold = await self._patiently(body, dry_run)
            await asyncio.sleep(min(hold, until - time.monotonic()))
            self._metrics.admissions.labels("wired" if found.spec is not None else "left").inc()
            return found
        except (ApiError, NotWired) as error:
            text = str(error)
        except TimeoutError:
            text = f"the API server did not answer within {LONGEST:g} s; create the pod anew"
        except Exception as error:
            log.exception("a pod could not be wired")
            text = f"the controller failed: {error!r}"
        self._metrics.admissions.labels("failed").inc()
        log.warning("a pod at admission: %s", text)
        return Wiring(warnings=(NOT_WIRED + text,))

    async def _patiently(self, body: Json, dry_run: bool) -> tuple[Wiring, float]:
        """What a pod needs, also from an API server that is just starting; and how long to wait."""
        while True:
            try:
                return await in_thread(self._wiring, body, dry_run)
            except ApiError as error:
                if error.kind is not Kind.AWAY:
                    raise
                log.debug("a pod at admission: %s; trying again", error)
            await asyncio.sleep(AGAIN)

    def _wiring(self, body: Json, dry_run: bool) -> tuple[Wiring, float]:
        pod = parse_pod(body)
        rosproxies, unusable = self._rosproxies(pod.id.namespace)
        choice = chosen(pod, rosproxies)
        if choice.rosproxy is not None:
            address, hold = self._address(choice.rosproxy, dry_run)
            return wire(body, master_uri(address), choice.rosproxy.spec.host_aliases), hold
        text = choice.finding.text if choice.finding else self._nobody(pod, rosproxies, unusable)
        return Wiring(warnings=(NOT_WIRED + text,) if text else ()), 0.0

    def _nobody(self, pod: Pod, rosproxies: list[RosProxy], unusable: list[str]) -> str:
        text = nobody(pod, rosproxies)
        return "; ".join([text, *unusable]) if text else ""

    def _rosproxies(self, namespace: str) -> tuple[list[RosProxy], list[str]]:
        """Those of a namespace, and what is wrong with those that can't be read."""
        usable, unusable = [], []
        for found in self._api.rosproxies(namespace, SOON):
            try:
                usable.append(rosproxy(found))
            except Unusable as error:
                unusable.append(f"RosProxy {found['metadata']['name']}: {error}")
        return [each for each in usable if not each.deleting], unusable

    def _address(self, of: RosProxy, dry_run: bool) -> tuple[str, float]:
        """The cluster IP of a RosProxy's Service, and in how many seconds it works everywhere.

        The Service is created if need be.
        """
        address, hold = self._service(of)
        if not address and not dry_run:
            create_service(self._api, service_body(of, of.cluster_ip), SOON)
            address, hold = self._service(of)
        address = address or (of.cluster_ip if dry_run else "")
        if not address:
            raise NotWired(f"the Service {service_id(of.id)} has no cluster IP yet")
        return address, 0.0 if dry_run else hold

    def _service(self, of: RosProxy) -> tuple[str, float]:
        try:
            there = self._api.get("services", service_id(of.id), SOON)
        except ApiError as error:
            if error.kind is Kind.GONE:
                return "", 0.0
            raise
        found = parse_service(there)
        if found is None:
            raise NotWired(
                f"the Service {service_id(of.id)} is not the controller's: delete or rename it"
            )
        fits = found.owner == of.uid and not found.deleting
        return (found.cluster_ip, _until_known(there, time.time())) if fits else ("", 0.0)


def _until_known(service: Found, now: float) -> float:
    """Seconds until all nodes know a Service. ``now`` is in seconds of Unix time."""
    try:
        made = datetime.fromisoformat(str(service["metadata"]["creationTimestamp"])).timestamp()
    except (KeyError, ValueError):
        return 0.0
    return min(max(made + YOUNG - now, 0.0), YOUNG)
