"""The settings of ``rosproxy-operator kubernetes``: plain data, each written once.

See `rosproxy.settings`. Only what decides whether the webhook is served has its option in
`rosproxy_operator.cli`: without it there is none.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import msgspec

from rosproxy import setting_kinds as kinds
from rosproxy.access.layers import PolicyLayer
from rosproxy.leases.ports import PortRange
from rosproxy.net.addresses import HostPort
from rosproxy.setting_kinds import (
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
from rosproxy_operator.kubernetes.resources.model import Json, Name
from rosproxy_operator.kubernetes.resources.spec import MOST_PORTS

DEFAULT_ADMIN = HostPort("0.0.0.0", 11313)
DEFAULT_LIVENESS = HostPort("0.0.0.0", 8080)
DEFAULT_WEBHOOK = HostPort("0.0.0.0", 9443)
NODE_PORTS = PortRange(30000, 32767)
"""The API server's own default of --service-node-port-range."""
EPHEMERAL = PortRange(32768, 60999)
"""Linux's own default of net.ipv4.ip_local_port_range."""
EVERY_PORT = PortRange(1024, 65535)
"""Where the custom resource definition lets hostPorts lie."""


class Bounds(msgspec.Struct, frozen=True):
    """What a RosProxy may ask for: the administrator's word, which no RosProxy can widen.

    ``masters``, ``images`` and ``peers`` are globs; ``window`` is where hostPorts may lie, all of
    ``spec.portWindow`` and ``spec.master.publish``.
    """

    masters: Annotated[
        tuple[str, ...],
        Option(
            "Masters that a RosProxy may name, as `http://192.0.2.*:11311`. [How they are compared]"
            "(permissions.md#what-rosproxies-may-ask-for). Repeatable.",
            option_values.GLOB,
            name="--allow-master",
            repeatable=True,
            default="any",
        ),
    ] = ()
    max_ports: Annotated[
        int,
        Option(
            "Most ports that a RosProxy may ask for: the highest `spec.ports`.", option_values.PORTS
        ),
    ] = MOST_PORTS
    window: Annotated[
        PortRange,
        Option(
            "Where a RosProxy may have hostPorts: `spec.portWindow` and `spec.master.publish`.",
            kinds.PORT_RANGE,
            name="--allow-port-window",
        ),
    ] = EVERY_PORT
    data_planes: Annotated[
        tuple[DataPlane, ...],
        Option(
            "What `spec.dataPlane` may be; kernel takes NET_ADMIN. Repeatable.",
            name="--allow-data-plane",
            repeatable=True,
        ),
    ] = ("auto", "splice", "copy")
    images: Annotated[
        tuple[str, ...],
        Option(
            "Images that `spec.image` may name besides `--proxy-image`. Repeatable.",
            option_values.GLOB,
            name="--allow-image",
            repeatable=True,
            default="none",
        ),
    ] = ()
    slave_control: Annotated[
        SlaveControl,
        Option(
            "As the option of `rosproxy run`, for all proxies; `spec.policy.slaveControl` may only "
            "narrow it."
        ),
    ] = "any"
    peers: Annotated[
        tuple[str, ...],
        Option(
            "ROS 2: hosts that `spec.peers` may name, as `192.0.2.*`. A pattern without letters "
            "fits addresses only. Repeatable.",
            option_values.GLOB,
            name="--allow-peer",
            repeatable=True,
            default="any",
        ),
    ] = ()
    multicast: Annotated[
        bool,
        Option(
            "ROS 2: whether `spec.multicast` may be true: pods in the nodes' own network, which "
            "hear the LAN.",
            name="--allow-multicast",
        ),
    ] = True


class ClusterSettings(msgspec.Struct, frozen=True):
    """The operator's options that decide what is planned.

    An empty ``image_pull_policy`` leaves it to Kubernetes. ``proxy_bounds`` are what each proxy may
    take, ``policy`` is the administrator's, for all proxies: one layer or none.
    """

    image: Annotated[
        str,
        Option("The proxies' image, where a RosProxy names none.", IMAGE, name="--proxy-image"),
    ] = "rosproxy:latest"
    image_pull_policy: Annotated[
        Literal["", "Always", "IfNotPresent", "Never"],
        Option("Its imagePullPolicy.", name="--proxy-image-pull-policy", default="Kubernetes' own"),
    ] = ""
    node_ports: Annotated[
        PortRange,
        Option(
            "The API server's `--service-node-port-range`: no proxy gets a port of it.",
            kinds.PORT_RANGE,
            name="--node-port-range",
        ),
    ] = NODE_PORTS
    ephemeral: Annotated[
        PortRange,
        Option(
            "The nodes' `net.ipv4.ip_local_port_range`, from which their kernels take ports for "
            "connections: no proxy gets a port of it.",
            kinds.PORT_RANGE,
            name="--ephemeral-range",
        ),
    ] = EPHEMERAL
    bounds: Bounds = Bounds()
    network_policy: Annotated[
        bool,
        Option(
            "Whether each RosProxy's proxies get [a NetworkPolicy](permissions.md#networkpolicy)."
        ),
    ] = True
    admin_from: Annotated[
        tuple[Json, ...] | None,
        Option(
            "Whom it lets reach the proxies' admin port: a JSON list of NetworkPolicyPeers.",
            option_values.NETWORK_PEERS,
            default="everybody",
        ),
    ] = None
    proxy_bounds: ProxyBounds = OWN_BOUNDS
    policy: tuple[PolicyLayer, ...] = ()


class WebhookSettings(msgspec.Struct, frozen=True):
    """How the admission webhook is served, and with which certificate.

    Either the operator makes the certificate, for the names of ``service``, keeps it in
    ``secret`` and writes its CA into ``configuration`` (each may be None or empty: it is left
    out); or somebody else puts it into ``directory`` (tls.crt, tls.key).
    """

    bind: HostPort = DEFAULT_WEBHOOK
    service: Annotated[
        Name | None,
        Option(
            "The webhook's Service, for whose names its certificate is made.",
            option_values.NAME,
            name="--webhook-service",
            default="none",
        ),
    ] = None
    secret: Annotated[
        Name | None,
        Option(
            "An existing Secret in which the certificate is kept. Without it a new one is made at "
            "each start.",
            option_values.NAME,
            name="--webhook-secret",
            default="none",
        ),
    ] = None
    configuration: Annotated[
        str,
        Option(
            "The MutatingWebhookConfiguration that is given its authority.",
            option_values.OBJECT_NAME,
            name="--webhook-configuration",
            default="none",
        ),
    ] = ""
    directory: Annotated[
        str,
        Option(
            "`tls.crt` and `tls.key` of somebody else's making, instead of the last three; read "
            "again when they change.",
            option_values.DIRECTORY,
            name="--webhook-cert-dir",
            default="none",
        ),
    ] = ""


class KubernetesSettings(msgspec.Struct, frozen=True):
    """Everything that ``rosproxy-operator kubernetes`` can be told.

    ``resync`` is in seconds. Without ``webhook`` pods are not wired. Without ``key_secret`` the key
    of the proxies' tokens is made anew with each start; without ``lease`` it is the only operator.
    """

    plan: ClusterSettings = ClusterSettings()
    namespaces: Annotated[
        tuple[str, ...],
        Option(
            "Namespaces whose RosProxies are looked after. Repeatable.",
            option_values.NAMESPACE,
            name="--namespace",
            repeatable=True,
            default="all",
        ),
    ] = ()
    key_secret: Annotated[
        Name | None,
        Option(
            "An existing Secret in which the key of the proxies' tokens is kept. Without it a new "
            "one is made at each start, and the proxies anew.",
            option_values.NAME,
            default="none",
        ),
    ] = None
    lease: Annotated[
        Name | None,
        Option(
            "The Lease by which several operators [choose the one that acts]"
            "(../guide/kubernetes.md#two-operators). They share `--key-secret` and "
            "`--webhook-secret`.",
            option_values.NAME,
            default="there is no other",
        ),
    ] = None
    resync: Annotated[float, Option("Longest time between two looks.", time(1.0))] = 30.0
    webhook: WebhookSettings | None = None
    admin: Annotated[
        HostPort,
        Option(
            "Where `/healthz`, `/readyz`, `/metrics` and the [live page of all proxies]"
            "(../guide/live-page.md#all-proxies-of-a-host-or-a-cluster) are, which is for callers "
            "on loopback (`kubectl port-forward`).",
            kinds.host_port(DEFAULT_ADMIN),
            name="--admin-bind",
        ),
    ] = DEFAULT_ADMIN
    liveness: Annotated[
        HostPort,
        Option(
            "Where `/healthz` is served for the kubelet: it fails when any part hangs.",
            kinds.host_port(DEFAULT_LIVENESS),
            name="--liveness-bind",
        ),
    ] = DEFAULT_LIVENESS


def make_kubernetes_settings(options: Mapping[str, Any]) -> KubernetesSettings:
    """Settings from the values of the command line's options, by their names.

    Raises SettingError if they don't go together.
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
    """Raise SettingError if several operators could not share what they have to."""
    if options["lease"] is None:
        return
    if options["key_secret"] is None:
        raise SettingError("--key-secret", "is needed with --lease: all operators share the key")
    own = options["webhook_bind"] and not options["webhook_cert_dir"]
    if own and options["webhook_secret"] is None:
        text = "is needed with --lease: all operators serve the same certificate"
        raise SettingError("--webhook-secret", text)


def _make_webhook(options: Mapping[str, Any]) -> WebhookSettings:
    settings = make_settings(WebhookSettings, options, bind=options["webhook_bind"])
    if settings.directory and (settings.secret or settings.configuration):
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
    return settings
