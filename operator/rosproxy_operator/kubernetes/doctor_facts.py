"""The facts that the doctor reads: RosProxies, operators, pods, the webhook and Events.

All requests use the rights of the doctor's user. A refused request becomes a finding, most often
about a missing right, and the doctor sends the next request. A list of RosProxies or of the
operator's pods that fails for another reason ends the doctor.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import TypeVar

from rosproxy.shared.documents.doctor_finding import DoctorFinding, error, note, warning
from rosproxy_operator.kubernetes.api.api_client import (
    ENDPOINTS,
    WEBHOOKS,
    Api,
    ApiError,
    ApiNotFound,
    ApiUnavailable,
)
from rosproxy_operator.kubernetes.api.rbac import missing_right
from rosproxy_operator.kubernetes.planner.pods.trial import trial_pod
from rosproxy_operator.kubernetes.planner.pods.wiring import UNWIRED
from rosproxy_operator.kubernetes.resources import objects
from rosproxy_operator.kubernetes.resources.checks import submap, submaps, text_at
from rosproxy_operator.kubernetes.resources.model import Json, Name, Pod, RosProxy
from rosproxy_operator.kubernetes.resources.names import INJECT, service_id
from rosproxy_operator.kubernetes.status.condition_findings import is_unnoticed
from rosproxy_operator.kubernetes.status.event_findings import (
    MOST_EVENTS,
    RecentEvent,
    recent_events,
)
from rosproxy_operator.kubernetes.status.operator_findings import (
    OPERATOR_SELECTOR,
    Operators,
    service_accounts,
)
from rosproxy_operator.kubernetes.status.webhook_findings import (
    FAILED_CALL,
    Trial,
    WebhookFacts,
    our_webhook,
    service_of,
)

T = TypeVar("T")
MOST_CHECKED_EVENTS = 3 * MOST_EVENTS
"""Most Events for which the doctor checks whether the pod still exists."""
RETRIAL_PAUSE_S = 2.0
"""Seconds between two trials of the webhook.

For a second after the start of an operator, kube-proxy may still lead to the former operator.
"""


class DoctorFacts:
    """Reads facts from the API server. ``refused`` has a finding for each failed request."""

    def __init__(self, api: Api, namespaces: Sequence[str]) -> None:
        self._api = api
        self._places = tuple(namespaces) or ("",)
        self.refused: list[DoctorFinding] = []

    def rosproxies(self) -> Sequence[Json] | None:
        """Return the RosProxies; None without the right to list them.

        Raises ApiError if the request fails for another reason.
        """
        return self._need("rosproxy", self._api.rosproxies)

    def own_pods(self) -> Sequence[Json]:
        """Return the pods that the operator has made; none without the right to list pods.

        Raises ApiError if the request fails for another reason.
        """
        return self._need("proxy", self._api.own_pods) or ()

    def operators(self, rosproxies: Iterable[Json]) -> Operators:
        """Return the operators' pods, and the namespaces where no operator may write a status.

        The doctor checks only namespaces with a RosProxy that no operator has looked at.
        """
        pods = self._ask(
            "operator", lambda: self._api.list_fresh("pods", "", labels=OPERATOR_SELECTOR)
        )
        found = Operators(None if pods is None else tuple(pods))
        unnoticed = (rosproxy for rosproxy in rosproxies if is_unnoticed(rosproxy))
        namespaces = {text_at(submap(r, "metadata"), "namespace") for r in unnoticed}
        refused = self._ask("operator", lambda: self._refused(found, namespaces))
        return Operators(found.pods, refused or frozenset())

    def _refused(self, operators: Operators, namespaces: Iterable[str]) -> frozenset[str]:
        """Return the namespaces that operators manage without the right to write a status."""
        may_write = self._api.may_patch_status
        accounts = {name: service_accounts(operators, name) for name in sorted(namespaces)}
        return frozenset(
            name
            for name, group in accounts.items()
            if group and not any(may_write(account, name) for account in group)
        )

    def labelled_pods(self) -> list[Pod]:
        """Return the live pods with the label rosproxy.io/inject, or with a misspelt name."""
        found: list[Pod] = []
        for place in self._places:
            found += self._ask("pods", partial(self._labelled, place)) or []
        return found

    def _labelled(self, place: str) -> list[Pod]:
        # No label selector finds a misspelt label.
        pods = map(objects.pod, self._api.each("pods", place, ""))
        labelled = (pod for pod in pods if INJECT in pod.labels or pod.misspelt)
        return [pod for pod in labelled if not (pod.ended or pod.deleting)]

    def webhook(
        self, operators: Operators, unreached: Sequence[str], rosproxies: Sequence[RosProxy]
    ) -> WebhookFacts:
        """Return the webhook's configurations, and how many endpoints of each Service are ready.

        ``unreached`` has the pods that no webhook wired (`labelled.unreached`). A trial tells
        whether the API server reaches the operators now.
        """
        api = self._api
        listed = self._ask("webhook", lambda: api.list_fresh(WEBHOOKS, ""))
        if listed is None:
            return WebhookFacts()
        ours = tuple(configuration for configuration in listed if our_webhook(configuration))
        if not ours:
            return WebhookFacts((), operators.pods)
        ready: dict[Name, int | None] = {}
        for service in {service_of(configuration) for configuration in ours}:
            self._ask("webhook", partial(self._count_ready, service, ready))
        trials: dict[str, Trial] = {}
        for configuration in ours:
            if ready.get(service_of(configuration)):
                trial = self._ask("webhook", partial(self._trial, configuration, rosproxies))
                trials |= {text_at(configuration["metadata"], "name"): trial} if trial else {}
        return WebhookFacts(ours, ready=ready, unreached=unreached, trials=trials)

    def _trial(self, configuration: Json, rosproxies: Sequence[RosProxy]) -> Trial | None:
        """Let the API server call a webhook for a pod, in a dry run. None: this tells nothing."""
        body = trial_pod(our_webhook(configuration), rosproxies)
        if body is None:
            return None
        trial = self._try(body)
        if trial is None or trial.is_wired:
            return trial
        time.sleep(RETRIAL_PAUSE_S)
        return self._try(body)

    def _try(self, body: Json) -> Trial | None:
        """Try the webhook once. Raises ApiError for a missing right, or without an answer.

        Another program, such as a quota or a policy of the cluster, may refuse the pod. That is no
        fault, because real pods differ from this pod. So a note reports it.
        """
        namespace = text_at(body["metadata"], "namespace")
        try:
            answer, warnings = self._api.try_creation("pods", body)
        except ApiError as failure:
            if FAILED_CALL in str(failure):
                return Trial(namespace, error=str(failure))
            if isinstance(failure, ApiUnavailable) or missing_right(str(failure)):
                raise
            text, fix = _not_checked(failure)
            self.refused.append(note("webhook", "webhook", text, fix))
            return None
        pod = objects.pod(answer)
        is_wired = bool(pod.wired_master_uri or pod.static_peers or pod.router_endpoint)
        if not is_wired and UNWIRED in warnings:
            return None  # an operator answered, and the RosProxy has a fault
        return Trial(namespace, is_wired)

    def events(self, rosproxies: Sequence[Json], own_pods: Sequence[Json]) -> list[RecentEvent]:
        """Return Warning Events of these objects and of users' existing pods, the newest first."""
        events: list[Json] = []
        for place in self._places:
            events += self._ask("events", partial(self._warnings, place)) or []
        recent = recent_events(events, rosproxies, own_pods, time.time())
        ours = {text_at(submap(obj, "metadata"), "uid") for obj in (*rosproxies, *own_pods)}
        return [e for e in recent[:MOST_CHECKED_EVENTS] if e.uid in ours or self._pod_exists(e)]

    def _warnings(self, place: str) -> list[Json]:
        return [*self._api.list_fresh("events", place, fields="type=Warning")]

    def _pod_exists(self, event: RecentEvent) -> bool:
        """Whether the pod of an Event exists. After a failed request, the answer is yes."""
        try:
            pod = self._api.get("pods", event.id)
        except ApiNotFound:
            return False
        except ApiError:
            return True
        return text_at(submap(pod, "metadata"), "uid") == event.uid

    def service_since(self, rosproxy: Name) -> str:
        """Return since when a RosProxy has its Service, in RFC 3339; empty if unknown."""
        try:
            service = self._api.get("services", service_id(rosproxy))
        except ApiError:
            return ""
        return text_at(submap(service, "metadata"), "creationTimestamp")

    def _count_ready(self, service: Name, ready: dict[Name, int | None]) -> None:
        """Store in ``ready`` how many endpoints of a Service are ready; None: no such Service."""
        try:
            self._api.get("services", service)
        except ApiNotFound:
            ready[service] = None
            return
        selector = f"kubernetes.io/service-name={service.name}"
        slices = self._api.list_fresh(ENDPOINTS, service.namespace, labels=selector)
        endpoints = (e for endpoint_slice in slices for e in submaps(endpoint_slice, "endpoints"))
        ready[service] = sum(submap(e, "conditions").get("ready") is not False for e in endpoints)

    def _ask(self, subject: str, question: Callable[[], T]) -> T | None:
        """Return the answer. If the request fails, add a finding to ``refused`` and return None."""
        try:
            return question()
        except ApiError as failure:
            text, fix = _not_checked(failure)
            self.refused.append(warning(subject, subject, text, fix))
            return None

    def _need(self, subject: str, question: Callable[[], T]) -> T | None:
        """Return the answer. Without the right, add an error to ``refused`` and return None.

        Without this answer, the doctor checks too little to say that the cluster has no fault.
        """
        try:
            return question()
        except ApiError as failure:
            if not missing_right(str(failure)):
                raise
            text, fix = _not_checked(failure)
            self.refused.append(error(subject, subject, text, fix))
            return None


def _not_checked(failure: ApiError) -> tuple[str, str]:
    """The text and the fix of the finding about a failed request."""
    right = missing_right(str(failure))
    if not right:
        return f"not checked: {failure}", ""
    fix = f"check with kubectl auth can-i {right}; ask a user with this right to run the doctor"
    return f"not checked: you lack the right to {right}", fix


def ready_pods(pods: Iterable[Json]) -> frozenset[str]:
    """Return the uids of the pods that are ready."""
    return frozenset(
        text_at(submap(pod, "metadata"), "uid")
        for pod in pods
        if any(
            c.get("type") == "Ready" and c.get("status") == "True"
            for c in submaps(submap(pod, "status"), "conditions")
        )
    )
