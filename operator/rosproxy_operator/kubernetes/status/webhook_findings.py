"""The doctor's findings about the webhook that wires pods: about configuration, CA and Service.

The webhook refuses no pod. If the webhook fails, pods start unwired, and the nodes in these pods
don't find the proxy.
"""

from collections.abc import Iterator, Mapping, Sequence

import msgspec

from rosproxy.shared.documents.doctor_finding import DoctorFinding, error, note, ok, warning
from rosproxy.shared.output.text import clean, listed, plural
from rosproxy_operator.kubernetes.resources.checks import submap, submaps, text_at, texts_at
from rosproxy_operator.kubernetes.resources.model import Json, Name
from rosproxy_operator.kubernetes.resources.names import INJECT
from rosproxy_operator.kubernetes.status.operator_findings import describe_operators
from rosproxy_operator.kubernetes.status.operator_options import option_values

NAME = "wire.rosproxy.io"
"""The name of the webhook in the MutatingWebhookConfiguration."""
_CHECK = "webhook"
_REWIRE = "then create unwired pods again: kubectl rollout restart"
_NO_ANSWER = "no operator answered the API server at the webhook port (chart value webhook.port)"
FAILED_CALL = f'failed calling webhook "{NAME}"'
"""What the API server writes when it reaches no operator: into its log, or into its refusal."""
_REINSTALL = "create the object again: helm upgrade, or kubectl apply -f manifests/install.yaml"


class Trial(msgspec.Struct, frozen=True):
    """What the API server answered about a labelled pod in a dry run, in a namespace.

    ``is_wired``: an operator wired the pod. Otherwise no operator answered the API server.
    ``error`` is the refusal of the pod, with failurePolicy Fail.
    """

    namespace: str
    is_wired: bool = False
    error: str = ""


class WebhookFacts(msgspec.Struct, frozen=True):
    """The objects of the webhook in the cluster. None means that the doctor could not read them.

    - ``configurations``: the MutatingWebhookConfigurations with our webhook.
    - ``operators``: the pods of operators, given only if there is no configuration.
    - ``ready``: the number of ready endpoints of each Service, None for a missing Service. A
      Service that the doctor could not read has no entry.
    - ``unreached``: the unwired pods that were created while an operator was ready.
    - ``trials``: the trials, by the name of the configuration.
    """

    configurations: tuple[Json, ...] | None = None
    operators: tuple[Json, ...] | None = None
    ready: Mapping[Name, int | None] = {}
    unreached: Sequence[str] = ()
    trials: Mapping[str, Trial] = {}


def our_webhook(configuration: Json) -> Json:
    """Our webhook in a configuration; empty if the configuration has only other webhooks."""
    webhooks = submaps(configuration, "webhooks")
    return next((w for w in webhooks if w.get("name") == NAME), {})


def service_of(configuration: Json) -> Name:
    """The Service that the API server calls for our webhook."""
    service = submap(our_webhook(configuration), "clientConfig", "service")
    return Name(text_at(service, "namespace"), text_at(service, "name"))


def webhook_findings(facts: WebhookFacts) -> Iterator[DoctorFinding]:
    """The findings about the webhook; none if the doctor could not read the configurations."""
    if facts.configurations is None:
        return
    if not facts.configurations and facts.operators != ():  # else `operator_findings` reports
        yield _missing(facts.operators)
    for configuration in facts.configurations:
        yield from _findings_of(configuration, facts)


def _missing(operators: tuple[Json, ...] | None) -> DoctorFinding:
    text = (
        f"no MutatingWebhookConfiguration has the webhook {NAME}, so no pod with the label "
        f"{INJECT} is wired"
    )
    if operators is None:
        fix = f"unless the webhook is switched off (webhook.enabled=false), {_REINSTALL}; {_REWIRE}"
        return warning(_CHECK, _CHECK, text, fix)
    if any(_serves(pod) for pod in operators):
        text = f"{text}, although operators serve the webhook"
        return error(_CHECK, _CHECK, text, f"{_REINSTALL}; {_REWIRE}")
    text = f"{text}. The operators do not serve the webhook (webhook.enabled=false)"
    return note(_CHECK, _CHECK, text)


def _serves(operator: Json) -> bool:
    """Whether an operator serves the webhook. The last of several values counts."""
    return option_values(operator, "--webhook-bind")[-1:] not in ([], ["none"])


def _findings_of(configuration: Json, facts: WebhookFacts) -> Iterator[DoctorFinding]:
    metadata = submap(configuration, "metadata")
    service = service_of(configuration)
    subject = f"webhook {text_at(metadata, 'name')}"
    lacks_ca = not text_at(submap(our_webhook(configuration), "clientConfig"), "caBundle")
    if lacks_ca:
        text = (
            "the configuration has no caBundle, so the API server trusts no operator, and no pod "
            "is wired"
        )
        yield error(_CHECK, subject, text, f"{_ca_fix(metadata, service)}; {_REWIRE}")
    if not service.name or service not in facts.ready:
        return
    ready = facts.ready[service]
    if ready is None:
        text = f"the Service {service} of the webhook does not exist, so no pod is wired"
        yield error(_CHECK, subject, text, f"{_REINSTALL}; {_REWIRE}")
    elif not ready:
        text = f"the Service {service} of the webhook has no ready endpoint, so no pod is wired"
        yield error(_CHECK, subject, text, f"{describe_operators(service.namespace)}; {_REWIRE}")
    elif not lacks_ca:
        trial = facts.trials.get(text_at(metadata, "name"))
        if trial is not None and not trial.is_wired:
            yield _cut_off(subject, service, _text_of_trial(trial))
            return
        if trial is None and facts.unreached:
            yield _cut_off(subject, service, _text_of_pods(facts.unreached))
            return
        text = f"{plural(ready, 'operator')} ready to wire pods"
        tried = f", and wired a pod of a dry run in namespace {trial.namespace}" if trial else ""
        yield ok(_CHECK, subject, text + tried)


def _text_of_pods(pods: Sequence[str]) -> str:
    return (
        f"{_NO_ANSWER} when these pods were created, although an operator was ready: {listed(pods)}"
    )


def _text_of_trial(trial: Trial) -> str:
    result = f" ({clean(trial.error)})" if trial.error else ""
    return (
        f"{_NO_ANSWER} in a dry run, although an operator is ready: a new pod with the label "
        f"{INJECT} in namespace {trial.namespace} is {'refused' if trial.error else 'not wired'}"
        f"{result}"
    )


def _cut_off(subject: str, service: Name, text: str) -> DoctorFinding:
    fix = (
        "allow connections from the API server to the webhook port of the operator's pods in "
        "namespace "
        f"{service.namespace} (NetworkPolicy, firewall of the control plane); the API server's log "
        f"has {FAILED_CALL}; {_REWIRE}"
    )
    return error(_CHECK, subject, text, fix)


def _ca_fix(metadata: Json, service: Name) -> str:
    if "cert-manager.io/inject-ca-from" in texts_at(metadata, "annotations"):
        source = f"kubectl -n {service.namespace} get certificates"
        return f"check that cert-manager's cainjector runs, which sets the caBundle; read {source}"
    return (
        "wait 20 s for the leading operator, which sets the caBundle if its role may patch this "
        f"object; then read kubectl -n {service.namespace} logs -l "
        "app.kubernetes.io/component=operator --prefix"
    )
