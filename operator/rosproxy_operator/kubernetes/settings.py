"""The settings of ``rosproxy-operator kubernetes``, validated."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from rosproxy.net.addresses import HostPort, parse_host_port
from rosproxy.settings import SettingError, parse_admin, parse_range, parse_seconds
from rosproxy_operator.common.settings import parse_image
from rosproxy_operator.kubernetes.planner.model import Name
from rosproxy_operator.kubernetes.planner.settings import ClusterSettings

DEFAULT_ADMIN = HostPort("0.0.0.0", 11313)
DEFAULT_LIVENESS = HostPort("0.0.0.0", 8080)
DEFAULT_WEBHOOK = HostPort("0.0.0.0", 9443)
_LABEL = re.compile(r"[a-z0-9]([-a-z0-9]{0,61}[a-z0-9])?")
_SUBDOMAIN = re.compile(rf"(?=.{{1,253}}$){_LABEL.pattern}(\.{_LABEL.pattern})*")


@dataclass(frozen=True, slots=True)
class WebhookSettings:
    """How the admission webhook is served, and with which certificate.

    Either the operator makes the certificate, for the names of ``service``, keeps it in
    ``secret`` and writes its CA into ``configuration`` (each may be None or empty: it is left
    out); or somebody else puts it into ``directory`` (tls.crt, tls.key).
    """

    bind: HostPort = DEFAULT_WEBHOOK
    service: Name | None = None
    secret: Name | None = None
    configuration: str = ""
    directory: str = ""


@dataclass(frozen=True, slots=True)
class KubernetesSettings:
    """Everything that ``rosproxy-operator kubernetes`` can be told.

    ``namespaces`` are those that are looked after, all if there are none. ``resync`` is in seconds:
    how long it waits at most between two looks. ``admin`` is where it serves its own health and
    metrics, ``liveness`` where it tells that it is alive. Without ``webhook`` pods are not wired.
    """

    plan: ClusterSettings = field(default_factory=ClusterSettings)
    namespaces: tuple[str, ...] = ()
    resync: float = 30.0
    admin: HostPort = DEFAULT_ADMIN
    liveness: HostPort = DEFAULT_LIVENESS
    webhook: WebhookSettings | None = None


def parse_kubernetes_settings(options: Mapping[str, Any]) -> KubernetesSettings:
    """Settings from the values of the command line's options.

    Raises SettingError for the first value that can't be used.
    """
    plan = ClusterSettings(
        image=parse_image(options["proxy_image"]),
        image_pull_policy=options.get("proxy_image_pull_policy") or "",
        node_ports=parse_range("--node-port-range", options["node_port_range"]),
        ephemeral=parse_range("--ephemeral-range", options["ephemeral_range"]),
    )
    return KubernetesSettings(
        plan=plan,
        namespaces=_namespaces(options["namespace"]),
        resync=parse_seconds("--resync", options["resync"], 1.0),
        admin=parse_admin(options["admin_bind"], DEFAULT_ADMIN),
        liveness=_bind("--liveness-bind", options["liveness_bind"], DEFAULT_LIVENESS),
        webhook=_webhook(options),
    )


def _namespaces(names: Iterable[str]) -> tuple[str, ...]:
    for name in names:
        if not _LABEL.fullmatch(name):
            raise SettingError("--namespace", f"{name!r} is not a namespace's name")
    return tuple(dict.fromkeys(names))


def _bind(option: str, text: str, example: HostPort) -> HostPort:
    where = parse_host_port(text)
    if where is None:
        raise SettingError(option, f"{text!r} is not of the form {example}")
    return where


def _webhook(options: Mapping[str, Any]) -> WebhookSettings | None:
    if options["webhook_bind"] == "none":
        return None
    settings = WebhookSettings(
        bind=_bind("--webhook-bind", options["webhook_bind"], DEFAULT_WEBHOOK),
        service=_object("--webhook-service", options.get("webhook_service")),
        secret=_object("--webhook-secret", options.get("webhook_secret")),
        configuration=options.get("webhook_configuration") or "",
        directory=options.get("webhook_cert_dir") or "",
    )
    made = settings.secret or settings.configuration
    if settings.directory and made:
        raise SettingError(
            "--webhook-cert-dir",
            "the certificate comes from there: leave out --webhook-secret and "
            "--webhook-configuration",
        )
    if not settings.directory and settings.service is None:
        raise SettingError(
            "--webhook-service",
            "NAMESPACE/NAME is needed to make the webhook's certificate (or --webhook-cert-dir)",
        )
    if settings.configuration and not _SUBDOMAIN.fullmatch(settings.configuration):
        raise SettingError(
            "--webhook-configuration", f"{settings.configuration!r} is not an object's name"
        )
    return settings


def _object(option: str, text: str | None) -> Name | None:
    if not text:
        return None
    namespace, slash, name = text.partition("/")
    if not slash or not _LABEL.fullmatch(namespace) or not _SUBDOMAIN.fullmatch(name):
        raise SettingError(option, f"{text!r} is not of the form NAMESPACE/NAME")
    return Name(namespace, name)
