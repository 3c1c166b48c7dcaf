"""Kinds of values of the Kubernetes operator's options; see `rosproxy.shared.setting_kinds`."""

import msgspec

from rosproxy.shared.setting_kinds import Number, Text
from rosproxy_operator.kubernetes.resources.checks import is_label, is_subdomain
from rosproxy_operator.kubernetes.resources.fields import InvalidField
from rosproxy_operator.kubernetes.resources.model import Json, Name
from rosproxy_operator.kubernetes.resources.pod_defaults import PodDefaults, pod_defaults
from rosproxy_operator.kubernetes.resources.spec import MOST_PORTS


def read_namespace(text: str) -> str:
    """Return the name of a namespace. Raises ValueError."""
    if not is_label(text):
        raise ValueError(f"{text!r} can't be the name of a namespace")
    return text


def read_object_name(text: str) -> str:
    """Return the name of an object without a namespace; empty for no text. Raises ValueError."""
    if text and not is_subdomain(text):
        raise ValueError(f"{text!r} can't be the name of an object")
    return text


def read_name(text: str) -> Name | None:
    """Return the name from ``NAMESPACE/NAME``; None for no text. Raises ValueError."""
    namespace, slash, name = text.partition("/")
    if not text:
        return None
    if not slash or not is_label(namespace) or not is_subdomain(name):
        raise ValueError(f"{text!r} is not of the form NAMESPACE/NAME")
    return Name(namespace, name)


def read_glob(text: str) -> str:
    """Return a pattern with ``*`` and ``?``. Raises ValueError."""
    if not text or any(c.isspace() for c in text):
        raise ValueError(f"{text!r} is not a pattern such as http://192.0.2.*:11311")
    return text


def read_peers(text: str) -> tuple[Json, ...] | None:
    """Return a JSON list of NetworkPolicyPeers (networking.k8s.io/v1); None for no text.

    Raises ValueError, also for unknown fields. The API server would silently drop such a field, and
    the operator would write the field again and again.
    """
    if not text:
        return None
    try:
        return tuple(msgspec.to_builtins(msgspec.json.decode(text, type=list[_Peer])))
    except msgspec.DecodeError as error:
        raise ValueError(f"not a JSON list of NetworkPolicyPeers: {error}") from None


def read_pod_defaults(text: str) -> PodDefaults | None:
    """Return the chart value ``proxy.pod``, given as JSON; None for no text. Raises ValueError."""
    try:
        return pod_defaults(msgspec.json.decode(text)) if text else None
    except msgspec.DecodeError as error:
        raise ValueError(f"not JSON: {error}") from None
    except InvalidField as error:
        raise ValueError(str(error)) from None


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
    """A NetworkPolicyPeer (k8s.io/api, networking/v1/types.go)."""

    podSelector: _Selector | None = None  # noqa: N815
    namespaceSelector: _Selector | None = None  # noqa: N815
    ipBlock: _Block | None = None  # noqa: N815


PORTS = Number("N", 1, MOST_PORTS)
NAMESPACE = Text("NAME", read_namespace)
OBJECT_NAME = Text("NAME", read_object_name)
NAME = Text("NAMESPACE/NAME", read_name)
GLOB = Text("GLOB", read_glob)
POD_DEFAULTS = Text("JSON", read_pod_defaults, separable=False)
NETWORK_PEERS = Text("JSON", read_peers)
DIRECTORY = Text("DIR", str)
