"""The settings of ``rosproxy-operator kubernetes``: plain data, checked.

``read_…`` makes one value of a text and raises ValueError; see `rosproxy.settings`.
"""

from collections.abc import Mapping
from typing import Any

import msgspec

from rosproxy.access.layers import PolicyLayer
from rosproxy.leases.ports import PortRange
from rosproxy.net.addresses import HostPort
from rosproxy.values import DataPlane, SettingError
from rosproxy_operator.common.policy import administrators_policy
from rosproxy_operator.common.proxy_bounds import OWN_BOUNDS, ProxyBounds, make_proxy_bounds
from rosproxy_operator.kubernetes.resources.model import Json, Name
from rosproxy_operator.kubernetes.resources.spec import MOST_PORTS
from rosproxy_operator.kubernetes.resources.values import is_label, is_subdomain

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

    ``masters`` are globs of the masters' URIs, any if there are none; ``window`` is where hostPorts
    may lie, all of ``spec.portWindow`` and ``spec.master.publish``; ``images`` are globs of the
    images that ``spec.image`` may name besides the operator's own. ``slave_control`` is what holds
    for all: a RosProxy may only narrow it. Of ROS 2: ``peers`` are globs of the hosts that it may
    tell of participants, any if there are none; ``multicast``: whether it may hear the nodes' LAN,
    by pods in the nodes' own network.
    """

    masters: tuple[str, ...] = ()
    max_ports: int = MOST_PORTS
    window: PortRange = EVERY_PORT
    data_planes: tuple[DataPlane, ...] = ("auto", "splice", "copy")
    images: tuple[str, ...] = ()
    slave_control: str = "any"
    peers: tuple[str, ...] = ()
    multicast: bool = True


class ClusterSettings(msgspec.Struct, frozen=True):
    """The operator's options that decide what is planned.

    ``image`` and ``image_pull_policy`` are those of proxies whose RosProxy names none; an empty
    policy leaves it to Kubernetes. ``node_ports`` is the API server's --service-node-port-range,
    ``ephemeral`` the range from which the nodes' kernels take ports for connections: no hostPort
    is taken from either. ``network_policy``: whether RosProxies get one; ``admin_from`` are the
    NetworkPolicyPeers that it lets reach the proxies' admin endpoints, everybody if it is None.
    ``proxy_bounds`` are what each proxy may take, ``policy`` is the administrator's, for all
    proxies: one layer or none.
    """

    image: str = "rosproxy:latest"
    image_pull_policy: str = ""
    node_ports: PortRange = NODE_PORTS
    ephemeral: PortRange = EPHEMERAL
    bounds: Bounds = Bounds()
    network_policy: bool = True
    admin_from: tuple[Json, ...] | None = None
    proxy_bounds: ProxyBounds = OWN_BOUNDS
    policy: tuple[PolicyLayer, ...] = ()


class WebhookSettings(msgspec.Struct, frozen=True):
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


class KubernetesSettings(msgspec.Struct, frozen=True):
    """Everything that ``rosproxy-operator kubernetes`` can be told.

    ``namespaces`` are those that are looked after, all if there are none. ``resync`` is in seconds:
    how long it waits at most between two looks. ``admin`` is where it serves its own health and
    metrics, ``liveness`` where it tells that it is alive. Without ``webhook`` pods are not wired.
    ``key_secret`` is the Secret that holds the key of the proxies' tokens; None: it is made anew
    with each start. ``lease``: of all operators with the same one acts, and all share certificate
    and key; None: it is the only one.
    """

    plan: ClusterSettings = ClusterSettings()
    namespaces: tuple[str, ...] = ()
    resync: float = 30.0
    admin: HostPort = DEFAULT_ADMIN
    liveness: HostPort = DEFAULT_LIVENESS
    webhook: WebhookSettings | None = None
    key_secret: Name | None = None
    lease: Name | None = None


def make_kubernetes_settings(options: Mapping[str, Any]) -> KubernetesSettings:
    """Settings from the values of the command line's options, by their names.

    Raises SettingError if they don't go together.
    """
    _check_shared(options)
    return KubernetesSettings(
        plan=ClusterSettings(
            image=options["proxy_image"],
            image_pull_policy=options["proxy_image_pull_policy"] or "",
            node_ports=options["node_port_range"],
            ephemeral=options["ephemeral_range"],
            bounds=Bounds(
                masters=options["allow_master"],
                max_ports=options["max_ports"],
                window=options["allow_port_window"],
                data_planes=options["allow_data_plane"],
                images=options["allow_image"],
                slave_control=options["slave_control"],
                peers=options["allow_peer"],
                multicast=options["allow_multicast"],
            ),
            network_policy=options["network_policy"],
            admin_from=options["admin_from"],
            proxy_bounds=make_proxy_bounds(options),
            policy=administrators_policy(options["policy"], options["policy_mode"]),
        ),
        namespaces=tuple(dict.fromkeys(options["namespace"])),
        resync=options["resync"],
        admin=options["admin_bind"],
        liveness=options["liveness_bind"],
        webhook=_make_webhook(options) if options["webhook_bind"] else None,
        key_secret=options["key_secret"],
        lease=options["lease"],
    )


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


def read_namespace(text: str) -> str:
    """The name of a namespace. Raises ValueError."""
    if not is_label(text):
        raise ValueError(f"{text!r} is not a namespace's name")
    return text


def read_object_name(text: str) -> str:
    """The name of an object that has no namespace; empty for no text. Raises ValueError."""
    if text and not is_subdomain(text):
        raise ValueError(f"{text!r} is not an object's name")
    return text


def read_name(text: str) -> Name | None:
    """``NAMESPACE/NAME``; None for no text. Raises ValueError."""
    namespace, slash, name = text.partition("/")
    if not text:
        return None
    if not slash or not is_label(namespace) or not is_subdomain(name):
        raise ValueError(f"{text!r} is not of the form NAMESPACE/NAME")
    return Name(namespace, name)


def read_glob(text: str) -> str:
    """A pattern with ``*`` and ``?``. Raises ValueError."""
    if not text or any(c.isspace() for c in text):
        raise ValueError(f"{text!r} is no pattern such as http://192.0.2.*:11311")
    return text


def read_peers(text: str) -> tuple[Json, ...] | None:
    """A JSON list of NetworkPolicyPeers (networking.k8s.io/v1); None for no text.

    Raises ValueError. What the API server does not know it would drop without a word, and the
    operator would write it again and again: so it is refused here.
    """
    if not text:
        return None
    try:
        return tuple(msgspec.to_builtins(msgspec.json.decode(text, type=list[_Peer])))
    except msgspec.DecodeError as error:
        raise ValueError(f"is no JSON list of NetworkPolicyPeers: {error}") from None


class _Requirement(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    key: str
    operator: str
    values: list[str] = []


class _Selector(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    matchLabels: dict[str, str] = {}  # noqa: N815 - the API's names
    matchExpressions: list[_Requirement] = []  # noqa: N815


class _Block(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    cidr: str
    excepted: list[str] = msgspec.field(default_factory=list, name="except")


class _Peer(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    """A NetworkPolicyPeer, as k8s.io/api, networking/v1/types.go, has it."""

    podSelector: _Selector | None = None  # noqa: N815
    namespaceSelector: _Selector | None = None  # noqa: N815
    ipBlock: _Block | None = None  # noqa: N815


def _make_webhook(options: Mapping[str, Any]) -> WebhookSettings:
    settings = WebhookSettings(
        bind=options["webhook_bind"],
        service=options["webhook_service"],
        secret=options["webhook_secret"],
        configuration=options["webhook_configuration"] or "",
        directory=options["webhook_cert_dir"] or "",
    )
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
