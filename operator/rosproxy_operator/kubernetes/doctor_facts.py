"""What the doctor reads besides RosProxies: the webhook, and Events. With the caller's rights.

A question that the API server does not answer, most often for want of a right, becomes a finding,
and the others are asked all the same.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import TypeVar

from rosproxy.admin.doctor_finding import DoctorFinding, warning
from rosproxy_operator.kubernetes.api.api_client import (
    ENDPOINTS,
    WEBHOOKS,
    Api,
    ApiError,
    ApiNotFound,
)
from rosproxy_operator.kubernetes.api.rbac import missing_right
from rosproxy_operator.kubernetes.resources import objects
from rosproxy_operator.kubernetes.resources.checks import submap, submaps, text_at
from rosproxy_operator.kubernetes.resources.model import Json, Name, Pod
from rosproxy_operator.kubernetes.resources.names import INJECT
from rosproxy_operator.kubernetes.status.condition_findings import is_unnoticed
from rosproxy_operator.kubernetes.status.event_findings import MOST, RecentEvent, recent_events
from rosproxy_operator.kubernetes.status.operator_findings import (
    OPERATORS,
    Operators,
    service_account,
)
from rosproxy_operator.kubernetes.status.webhook_findings import (
    WebhookFacts,
    our_webhook,
    service_of,
)

T = TypeVar("T")
MOST_LOOKED_FOR = 3 * MOST
"""Pods at most that are looked for, to see whether an Event is about one that is there."""


class DoctorFacts:
    """Asks the API server. ``refused`` are findings about what it has not answered."""

    def __init__(self, api: Api, namespaces: Sequence[str]) -> None:
        self._api = api
        self._places = tuple(namespaces) or ("",)
        self.refused: list[DoctorFinding] = []

    def operators(self, rosproxies: Iterable[Json]) -> Operators:
        """The operators' pods, and where they may not write what the RosProxies' status is."""
        pods = self._ask("operator", lambda: self._api.list_fresh("pods", "", labels=OPERATORS))
        found = Operators(None if pods is None else tuple(pods))
        account = service_account(found)
        unnoticed = (rosproxy for rosproxy in rosproxies if is_unnoticed(rosproxy))
        namespaces = {text_at(submap(r, "metadata"), "namespace") for r in unnoticed}
        if account is None or not namespaces:
            return found
        refused = self._ask("operator", lambda: self._refused(account, namespaces))
        return Operators(found.pods, refused or frozenset())

    def _refused(self, account: Name, namespaces: Iterable[str]) -> frozenset[str]:
        may_write = self._api.may_patch_status
        return frozenset(n for n in sorted(namespaces) if not may_write(account, n))

    def meant_pods(self) -> list[Pod]:
        """The users' pods with the label rosproxy.io/inject, or with a misspelt name."""
        found: list[Pod] = []
        for place in self._places:
            found += self._ask("pods", partial(self._meant, place)) or []
        return found

    def _meant(self, place: str) -> list[Pod]:
        # No label selector finds a misspelt label.
        pods = map(objects.pod, self._api.each("pods", place, ""))
        meant = (pod for pod in pods if INJECT in pod.labels or pod.misspelt)
        return [pod for pod in meant if not (pod.ended or pod.deleting)]

    def webhook(self, operators: Operators, unreached: Sequence[str]) -> WebhookFacts:
        """What there is of the webhook."""
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
        return WebhookFacts(ours, ready=ready, unreached=unreached)

    def events(self, rosproxies: Sequence[Json], own_pods: Sequence[Json]) -> list[RecentEvent]:
        """The Warning Events of these, and of users' pods that are there, the newest first."""
        events: list[Json] = []
        for place in self._places:
            events += self._ask("events", partial(self._warnings, place)) or []
        recent = recent_events(events, rosproxies, own_pods, time.time())
        ours = {text_at(submap(obj, "metadata"), "uid") for obj in (*rosproxies, *own_pods)}
        return [e for e in recent[:MOST_LOOKED_FOR] if e.uid in ours or self._is_there(e)]

    def _warnings(self, place: str) -> list[Json]:
        return [*self._api.list_fresh("events", place, fields="type=Warning")]

    def _is_there(self, event: RecentEvent) -> bool:
        """Whether a pod is there still. One that can't be looked for counts as there."""
        try:
            pod = self._api.get("pods", event.id)
        except ApiNotFound:
            return False
        except ApiError:
            return True
        return text_at(submap(pod, "metadata"), "uid") == event.uid

    def _count_ready(self, service: Name, ready: dict[Name, int | None]) -> None:
        """Note how many endpoints of a Service are ready; None if there is no such Service."""
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
        """The answer; None if there is none, which becomes a finding."""
        try:
            return question()
        except ApiError as error:
            if right := missing_right(str(error)):
                text = f"not checked: you lack the right to {right}"
                fix = (
                    f"check with kubectl auth can-i {right}; ask a user with this right to run the "
                    "doctor"
                )
            else:
                text = f"not checked: {error}"
                fix = ""
            self.refused.append(warning(subject, subject, text, fix))
            return None


def ready_pods(pods: Iterable[Json]) -> frozenset[str]:
    """The uids of the pods that are ready."""
    return frozenset(
        text_at(submap(pod, "metadata"), "uid")
        for pod in pods
        if any(
            c.get("type") == "Ready" and c.get("status") == "True"
            for c in submaps(submap(pod, "status"), "conditions")
        )
    )
