"""The settings of ``rosproxy-operator kubernetes``: plain data, each setting written once.

See `rosproxy.shared.settings`. The option ``--webhook-bind`` is in `rosproxy_operator.cli`. Without
this option, the operator serves no webhook.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import msgspec

from rosproxy.shared import setting_kinds as kinds
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.policy.layers import PolicyLayer
from rosproxy.shared.ports import PortRange
from rosproxy.shared.setting_kinds import (
    DataPlane,
    Option,
    SettingError,
    SlaveControl,
    make_settings,
    time,
)
from rosproxy_operator.common.images import IMAGE
from rosproxy_operator.common.policy import administrators_policy
from rosproxy_operator.common.proxy_bounds import OWN_BOUNDS, ProxyBounds, make_proxy_bounds
from rosproxy_operator.kubernetes import option_values
from rosproxy_operator.kubernetes.resources.model import Json, ListenType, Name
from rosproxy_operator.kubernetes.resources.pod_defaults import PodDefaults
from rosproxy_operator.kubernetes.resources.spec import MOST_PORTS
from rosproxy_operator.proxy_spec.spec import WISHES

DEFAULT_ADMIN = HostPort("0.0.0.0", 11313)
DEFAULT_LIVENESS = HostPort("0.0.0.0", 8080)
DEFAULT_WEBHOOK = HostPort("0.0.0.0", 9443)
NODE_PORTS = PortRange(30000, 32767)
"""The API server's default of --service-node-port-range."""
EPHEMERAL = PortRange(32768, 60999)
"""Linux's default of net.ipv4.ip_local_port_range."""
EVERY_PORT = PortRange(1024, 65535)
"""Ports that the custom resource definition allows for hostPorts."""


class Bounds(msgspec.Struct, frozen=True):
    """The administrator's bounds of all RosProxies; no RosProxy can widen a bound.

    ``masters``, ``images`` and ``peers`` are globs. ``window`` must contain all hostPorts:
    ``spec.portWindow`` and ``spec.master.publish``.
    """

    masters: Annotated[
        tuple[str, ...],
        Option(
            "Masters that a RosProxy may name, for example `http://192.0.2.*:11311`. For the "
            "comparison, see "
            "[docs/reference/permissions.md](permissions.md#what-rosproxies-may-ask-for). "
            "Repeatable.",
            option_values.GLOB,
            name="--allow-master",
            repeatable=True,
            default="any",
        ),
    ] = ()
    max_ports: Annotated[
        int,
        Option("Most ports that a RosProxy may ask for in `spec.ports`.", option_values.PORTS),
    ] = MOST_PORTS
    window: Annotated[
        PortRange,
        Option(
            "Ports from which a RosProxy may have hostPorts: `spec.portWindow` and "
            "`spec.master.publish` must lie in this range.",
            kinds.PORT_RANGE,
            name="--allow-port-window",
        ),
    ] = EVERY_PORT
    data_planes: Annotated[
        tuple[DataPlane, ...],
        Option(
            "Data plane that `spec.dataPlane` may ask for. `kernel` takes the capability "
            "NET_ADMIN. Repeatable.",
            name="--allow-data-plane",
            repeatable=True,
        ),
    ] = WISHES["data_plane"].free
    images: Annotated[
        tuple[str, ...],
        Option(
            "Images that `spec.image` may name, in addition to `--proxy-image`. Repeatable.",
            option_values.GLOB,
            name="--allow-image",
            repeatable=True,
            default="none",
        ),
    ] = ()
    slave_control: Annotated[
        SlaveControl,
        Option(
            "Which outside hosts may call `shutdown`, `publisherUpdate` and `paramUpdate` at "
            "the nodes of all proxies: `any`, or only the `master`'s host. "
            "`spec.policy.slaveControl` can only narrow this option."
        ),
    ] = "any"
    peers: Annotated[
        tuple[str, ...],
        Option(
            "ROS 2, also with rmw_zenoh: hosts that `spec.peers` and `spec.link.to` may name, for "
            "example `192.0.2.*` or `[fd00::*]`. A pattern without letters, or in brackets, "
            "matches addresses only. Repeatable.",
            option_values.GLOB,
            name="--allow-peer",
            repeatable=True,
            default="any",
        ),
    ] = ()
    multicast: Annotated[
        bool,
        Option(
            "ROS 2: whether a RosProxy may set `spec.multicast` to true. The operator then "
            "starts pods in the network of the cluster's nodes, which receive the LAN's "
            "multicast.",
            name="--allow-multicast",
        ),
    ] = True

    listen: Annotated[
        tuple[ListenType, ...],
        Option(
            "rmw_zenoh: type of Service that `spec.listen` may ask for. At such a Service, laptops "
            "reach the proxies, and zenoh does not authenticate laptops. Repeatable.",
            name="--allow-listen",
            repeatable=True,
            default="none",
        ),
    ] = ()


class ClusterSettings(msgspec.Struct, frozen=True):
    """The options of the operator that decide the plan.

    With an empty ``image_pull_policy``, Kubernetes decides. ``proxy_bounds`` are the bounds of each
    proxy. ``policy`` is the administrator's policy for all proxies: a single layer, or none.
    """

    image: Annotated[
        str,
        Option("Image of the proxies whose RosProxy names no image.", IMAGE, name="--proxy-image"),
    ] = "rosproxy:latest"
    image_pull_policy: Annotated[
        Literal["", "Always", "IfNotPresent", "Never"],
        Option(
            "The imagePullPolicy of the `--proxy-image`.",
            name="--proxy-image-pull-policy",
            default="Kubernetes' own",
        ),
    ] = ""
    pod: Annotated[
        PodDefaults,
        Option(
            "What the pods of all proxies have: `imagePullSecrets`, `nodeSelector`, "
            "`tolerations`, `resources`, `priorityClassName`, `labels`, `annotations` and "
            "`runAsUser`, as a JSON object. A RosProxy's field of the same name replaces the "
            "first four.",
            option_values.POD_DEFAULTS,
            name="--proxy-pod",
            default="the resources and the user in the chart's values",
        ),
    ] = PodDefaults()
    node_ports: Annotated[
        PortRange,
        Option(
            "The API server's `--service-node-port-range`. No proxy gets a port of this range.",
            kinds.PORT_RANGE,
            name="--node-port-range",
        ),
    ] = NODE_PORTS
    ephemeral: Annotated[
        PortRange,
        Option(
            "The `net.ipv4.ip_local_port_range` of the cluster's nodes, from which their "
            "kernels take ports for connections. No proxy gets a port of this range.",
            kinds.PORT_RANGE,
            name="--ephemeral-range",
        ),
    ] = EPHEMERAL
    bounds: Bounds = Bounds()
    network_policy: Annotated[
        bool,
        Option(
            "Whether the proxies of each RosProxy get [a "
            "NetworkPolicy](permissions.md#networkpolicy)."
        ),
    ] = True
    admin_from: Annotated[
        tuple[Json, ...] | None,
        Option(
            "Sources that the NetworkPolicy of the proxies admits to the admin port: a JSON list "
            "of NetworkPolicyPeers.",
            option_values.NETWORK_PEERS,
            default="all",
        ),
    ] = None
    proxy_bounds: ProxyBounds = OWN_BOUNDS
    policy: tuple[PolicyLayer, ...] = ()


class WebhookSettings(msgspec.Struct, frozen=True):
    """How the operator serves the admission webhook, and with which certificate.

    The certificate can be in ``directory`` (tls.crt, tls.key). Else the operator makes the
    certificate for the names of ``service``, keeps the certificate in ``secret``, and writes the CA
    into ``configuration``. Without ``secret`` or ``configuration``, the operator leaves out that
    step.
    """

    bind: HostPort = DEFAULT_WEBHOOK
    service: Annotated[
        Name | None,
        Option(
            "The webhook's Service. The operator makes the webhook's certificate for the names "
            "of this Service.",
            option_values.NAME,
            name="--webhook-service",
            default="none",
        ),
    ] = None
    secret: Annotated[
        Name | None,
        Option(
            "Existing Secret in which the operator keeps the certificate. Without this option, "
            "the operator makes a new certificate at each start.",
            option_values.NAME,
            name="--webhook-secret",
            default="none",
        ),
    ] = None
    configuration: Annotated[
        str,
        Option(
            "MutatingWebhookConfiguration into which the operator writes the certificate's "
            "authority (CA).",
            option_values.OBJECT_NAME,
            name="--webhook-configuration",
            default="none",
        ),
    ] = ""
    directory: Annotated[
        str,
        Option(
            "Directory with a certificate that the operator does not make: `tls.crt` and "
            "`tls.key`, in place of `--webhook-service`, `--webhook-secret` and "
            "`--webhook-configuration`. The operator reads both files again when they change.",
            option_values.DIRECTORY,
            name="--webhook-cert-dir",
            default="none",
        ),
    ] = ""


class KubernetesSettings(msgspec.Struct, frozen=True):
    """All settings of ``rosproxy-operator kubernetes``.

    ``resync`` is in seconds. Without ``webhook`` the operator wires no pods. Without ``key_secret``
    the operator makes a new key of the proxies' tokens at each start. Without ``lease`` there
    must be no second operator.
    """

    plan: ClusterSettings = ClusterSettings()
    namespaces: Annotated[
        tuple[str, ...],
        Option(
            "Namespace whose RosProxies the operator manages. Repeatable.",
            option_values.NAMESPACE,
            name="--namespace",
            repeatable=True,
            default="all",
        ),
    ] = ()
    key_secret: Annotated[
        Name | None,
        Option(
            "Existing Secret in which the operator keeps the key of the proxies' tokens. "
            "Without this option, the operator makes a new key and new proxies at each start.",
            option_values.NAME,
            default="none",
        ),
    ] = None
    lease: Annotated[
        Name | None,
        Option(
            "The Lease object by which several operators [choose the one that "
            "acts](../guide/kubernetes.md#two-operators). All of them must have the same "
            "`--key-secret` and `--webhook-secret`.",
            option_values.NAME,
            default="none: a single operator",
        ),
    ] = None
    resync: Annotated[
        float, Option("Longest time between two looks at the cluster.", time(1.0))
    ] = 300.0
    webhook: WebhookSettings | None = None
    admin: Annotated[
        HostPort,
        Option(
            "Address and port of `/healthz`, `/readyz`, `/metrics` and the [live page of all "
            "proxies](../guide/live-page.md#all-proxies-of-a-host-or-a-cluster). The live page "
            "is for callers on loopback (`kubectl port-forward`).",
            kinds.host_port(DEFAULT_ADMIN),
            name="--admin-bind",
        ),
    ] = DEFAULT_ADMIN
    liveness: Annotated[
        HostPort,
        Option(
            "Address and port of `/healthz` for the kubelet. The check fails when any part of "
            "the operator hangs.",
            kinds.host_port(DEFAULT_LIVENESS),
            name="--liveness-bind",
        ),
    ] = DEFAULT_LIVENESS


def make_kubernetes_settings(options: Mapping[str, Any]) -> KubernetesSettings:
    """Return the settings, from the values of the command line's options by name.

    Raises SettingError if two values exclude each other.
    """
    _check_shared(options)
    plan = make_settings(
        ClusterSettings,
        options,
        bounds=make_settings(Bounds, options),
        proxy_bounds=make_proxy_bounds(options),
        policy=administrators_policy(options["policy"], options["policy_mode"]),
    )
    webhook = _make_webhook(options) if options["webhook_bind"] else None
    return make_settings(KubernetesSettings, options, plan=plan, webhook=webhook)


def _check_shared(options: Mapping[str, Any]) -> None:
    """Raise SettingError if several operators have no key or certificate to share."""
    if options["lease"] is None:
        return
    if options["key_secret"] is None:
        raise SettingError(
            "--key-secret", "is needed with --lease, since all operators share the key"
        )
    own = options["webhook_bind"] and not options["webhook_cert_dir"]
    if own and options["webhook_secret"] is None:
        text = "is needed with --lease, since all operators serve the same certificate"
        raise SettingError("--webhook-secret", text)


def _make_webhook(options: Mapping[str, Any]) -> WebhookSettings:
    settings = make_settings(WebhookSettings, options, bind=options["webhook_bind"])
    if settings.directory and (settings.secret or settings.configuration):
        raise SettingError(
            "--webhook-cert-dir",
            "the certificate comes from this directory. Remove --webhook-secret and "
            "--webhook-configuration",
        )
    if not settings.directory and settings.service is None:
        raise SettingError(
            "--webhook-service",
            "is needed to create the webhook's certificate. Give NAMESPACE/NAME, or "
            "--webhook-cert-dir",
        )
    return settings
