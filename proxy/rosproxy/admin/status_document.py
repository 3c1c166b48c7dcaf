"""The document at ``/status``: one definition for the proxy and for all who read it.

`rosproxy.admin.common_status` fills it in; ``rosproxy status``, ``rosproxy doctor`` and the
operator read it with `parse_status` (text of an answer) or `read_status` (decoded JSON). It is made
of what ROS nodes say of themselves and may come from another version of the proxy. So reading is
tolerant: unknown keys are ignored, and what is missing or of another type gets its default. The
proxy bounds the document as a whole (`rosproxy.admin.status_bounds`), and ``left_out`` counts what
is missing. Another version may not, and texts may hold control characters.

Times are in seconds, rates in bytes per second; ``sent`` is what went outside.
"""

import json
from contextlib import suppress
from functools import cache
from types import UnionType
from typing import Annotated, Any, TypeVar, get_args, get_origin

import msgspec

# json.loads accepts NaN, Infinity and integers of any length, none of which is within these bounds.
# 2**63 - 1 is the largest one that msgspec takes.
Count = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
Seconds = Annotated[float, msgspec.Meta(ge=0, le=1e15)]
Rate = Annotated[float, msgspec.Meta(ge=0, le=1e18)]
Names = tuple[str, ...]
Document = TypeVar("Document", bound=msgspec.Struct)
MOST_ROWS = 50_000
"""JSON objects in a document that is read. One has 21 bytes at least, in a status of 1 MiB."""


# msgspec raises the latter for half of a surrogate pair, which json.loads takes.
_UNFIT = (msgspec.ValidationError, UnicodeEncodeError)


class NotAStatus(ValueError):
    """A text that is not the status of a rosproxy."""


class StatusSettings(msgspec.Struct, frozen=True):
    """The settings that other programs have to know.

    ``ros`` are the versions of ROS that it is for. ``inside_networks``: those in force, as CIDRs.
    ``direction``: ``out``, or ``both`` where inside reaches outside through the proxy, too.
    ``udp``: UDPROS from publishers outside can come in.
    ``selected``: how many addresses an operator has selected; None: it has told of none yet.
    """

    ros: Names = ("1",)
    master_port: Count = 11311
    publish_master: Count | None = None
    advertise_host: str = ""
    bind: str = "0.0.0.0"
    inside_networks: Names = ()
    direction: str = "out"
    udp: bool = False
    cleanup_after: Seconds = 0.0
    linger: Seconds = 0.0
    selected: Count | None = None

    @property
    def for_ros1(self) -> bool:
        """Whether it is for ROS 1."""
        return "1" in self.ros


class MasterStatus(msgspec.Struct, frozen=True):
    """The real master. ``pinned``: ``address`` was given and is not what its name leads to.

    Neither ``up`` nor an ``error``: it has not been asked yet. ``since``: how long it is so.
    """

    uri: str = ""
    address: str | None = None
    pinned: bool = False
    up: bool = False
    error: str = ""
    pid: int | None = None
    since: Seconds = 0.0
    round_trip: Seconds | None = None


class PortsStatus(msgspec.Struct, frozen=True):
    """The range of ports, ``A-B`` here and as outside sees it; others hold ``blocked`` of them.

    ``held_by``: the other proxies on this machine that have some of them.
    """

    listen: str = ""
    advertise: str = ""
    used: Count = 0
    free: Count = 0
    blocked: Count = 0
    held_by: Names = ()


class RangeProbeStatus(msgspec.Struct, frozen=True):
    """How the last try at ports of the range ended, ``age`` ago: the worst of several ports.

    ``reached``: outside gets in; None: not proven. The others are those of `PortProbe`.
    """

    reached: bool | None = None
    from_proxy: str = ""
    from_master: str = ""
    transport: str = ""
    age: Seconds = 0.0


class DataPlaneStatus(msgspec.Struct, frozen=True):
    """How topics are forwarded: as ``mode`` says or, for a ``reason``, by another ``plane``."""

    mode: str = ""
    plane: str = ""
    reason: str = ""


class NodePlaneStatus(msgspec.Struct, frozen=True):
    """What the kernel forwards for a node through its data ``port``; bytes of IP packets."""

    plane: str = ""
    port: Count | None = None
    reason: str | None = None
    connections: Count = 0
    sent: Count = 0
    received: Count = 0
    sent_rate: Rate = 0.0
    received_rate: Rate = 0.0


class StandInStatus(msgspec.Struct, frozen=True):
    """A port that stands in for a node or service outside, which ``uri`` names.

    ``connections`` and the rates are those of the proxy and of the kernel (``data_plane``).
    """

    port: Count = 0
    uri: str = ""
    connections: Count = 0
    sent_rate: Rate = 0.0
    received_rate: Rate = 0.0
    data_plane: NodePlaneStatus | None = None


class UdprosStatus(msgspec.Struct, frozen=True):
    """A subscription by UDPROS that the proxy passes on: who, where from and to, and the bytes.

    ``port`` is the proxy's UDP port, ``inward`` whether the subscriber is inside, ``dropped`` how
    many datagrams came from others than the publisher.
    """

    topic: str = ""
    caller_id: str = ""
    peer: str = ""
    port: Count = 0
    inward: bool = False
    bytes: Count = 0
    dropped: Count = 0


class ConnectionStatus(msgspec.Struct, frozen=True):
    """A relayed TCPROS connection: ``kind`` is topic or service, ``peer`` who came from outside."""

    kind: str = ""
    name: str = ""
    caller_id: str = ""
    peer: str = ""
    sent: Count = 0
    received: Count = 0
    sent_rate: Rate = 0.0
    received_rate: Rate = 0.0


class EndpointStatus(msgspec.Struct, frozen=True):
    """What is registered with one slave URI: one node as a rule, several for nodelets.

    ``nodes`` are their names, ``uri`` is what it calls itself and ``address`` where it was found.
    ``state`` is one of `rosproxy.ros1.registry.endpoint.STATES`.
    """

    nodes: Names = ()
    uri: str = ""
    address: str = ""
    advertised_uri: str = ""
    port: Count = 0
    state: str = ""
    publishes: Names = ()
    subscribes: Names = ()
    services: Names = ()
    parameters: Names = ()
    connections: tuple[ConnectionStatus, ...] = ()
    problems: Names = ()
    data_plane: NodePlaneStatus | None = None
    left_out: Count = 0

    @property
    def given_up(self) -> bool:
        """Whether the proxy has unregistered it, because it was gone."""
        return self.state == "cleaned" or self.has_ended

    @property
    def has_ended(self) -> bool:
        """Whether an operator has told that its container is gone: it is no fault."""
        return self.state == "ended"


class LayerStatus(msgspec.Struct, frozen=True):
    """A layer of rules in force; ``addresses``: how many nodes' it is for, None: for all."""

    name: str = ""
    mode: str = ""
    rules: Names = ()
    addresses: Count | None = None
    left_out: Count = 0


class HiddenStatus(msgspec.Struct, frozen=True):
    """What the policy keeps from the master: ``kind`` of rule, name, node, rule, the address."""

    kind: str = ""
    name: str = ""
    node: str = ""
    reason: str = ""
    address: str = ""


class PolicyStatus(msgspec.Struct, frozen=True):
    """The layers of rules in force, and the names that these rules hide."""

    layers: tuple[LayerStatus, ...] = ()
    hidden: tuple[HiddenStatus, ...] = ()
    left_out: Count = 0
    layers_left_out: Count = 0


class ProblemStatus(msgspec.Struct, frozen=True):
    """What the user should know, of which subject, how long ago noted, and if it ``holds`` yet."""

    age: Seconds = 0.0
    subject: str = ""
    text: str = ""
    holds: bool = False


class LocatorStatus(msgspec.Struct, frozen=True):
    """A port and the locator of a participant that it leads to.

    ``kind`` is metatraffic or data. ``plane``: who forwards, and where it is not the kernel, the
    ``reason``. ``datagrams`` and ``bytes`` are those that the proxy has passed on; those of the
    kernel are of IP packets.
    """

    port: Count = 0
    where: str = ""
    kind: str = ""
    datagrams: Count = 0
    bytes: Count = 0
    rate: Rate = 0.0
    plane: str = ""
    reason: str = ""
    kernel_datagrams: Count = 0
    kernel_bytes: Count = 0


class NamedTypeStatus(msgspec.Struct, frozen=True):
    """A topic or service, and its type, as a participant announces it."""

    name: str = ""
    type: str = ""


class ParticipantStatus(msgspec.Struct, frozen=True):
    """A participant of ROS 2, inside or outside, with the topics and services that it announces.

    ``leases`` are ports of the range for one inside; for one outside its stand-ins, which inside
    reaches. ``kept``: one inside keeps them for when the proxy starts again. ``proven``: one
    outside gets in at ports of the range, or has not been known for long enough to tell.
    ``problem``: what it lacks. ``domain``: that which it says it is in. ``security``,
    ``locator_fault`` and ``shortage``, the kind of ``problem``, are of
    `rosproxy.ros2.registry.participants`. ``types`` are those of the topics and services.
    """

    guid_prefix: str = ""
    address: str = ""
    vendor: str = ""
    leases: tuple[LocatorStatus, ...] = ()
    publishes: Names = ()
    subscribes: Names = ()
    services: Names = ()
    left_out: Count = 0
    kept: bool = False
    proven: bool = True
    problem: str = ""
    domain: Count | None = None
    security: str = ""
    locator_fault: str = ""
    shortage: str = ""
    types: tuple[NamedTypeStatus, ...] = ()


class MismatchStatus(msgspec.Struct, frozen=True):
    """A topic or service (``kind``) for which two participants don't match across the boundary.

    ``policy`` is the first for which they don't, with what the ``writer`` offers and the ``reader``
    requests; these are GUID prefixes.
    """

    kind: str = ""
    name: str = ""
    policy: str = ""
    offered: str = ""
    requested: str = ""
    writer: str = ""
    reader: str = ""


class DomainStatus(msgspec.Struct, frozen=True):
    """A domain of ROS 2: its participants, and what became of datagrams.

    ``discovery`` is where outside announces itself to the proxy, ``direction`` that of the proxy.
    ``dropped`` were refused, ``lost`` the kernel did not take; ``data_plane`` is for user data.
    ``not_compared`` counts pairs of a reader and a writer of which nothing is known.
    """

    domain: Count = 0
    discovery: str = ""
    peers: Names = ()
    lan_relay: str = ""
    direction: str = "out"
    ports_used: Count = 0
    ports_free: Count = 0
    dropped: Count = 0
    lost: Count = 0
    data_plane: DataPlaneStatus | None = None
    inside: tuple[ParticipantStatus, ...] = ()
    outside: tuple[ParticipantStatus, ...] = ()
    mismatches: tuple[MismatchStatus, ...] = ()
    mismatches_left_out: Count = 0
    not_compared: Count = 0
    left_out: Count = 0


class ZenohLinkStatus(msgspec.Struct, frozen=True):
    """A link of the hub router to a router outside, ``peer``; ``since``: how long it is so.

    ``error``: why the link is not up, one of `rosproxy.zenoh.links.LinkFault`.
    """

    peer: str = ""
    up: bool = False
    error: str = ""
    since: Seconds = 0.0


class ZenohSessionStatus(msgspec.Struct, frozen=True):
    """A session of a router of the proxy: both addresses, and the mode of the other end.

    ``port`` is that of the router; None: the hub. ``mode``: client, peer or router.
    """

    port: Count | None = None
    mode: str = ""
    zid: str = ""
    local: str = ""
    remote: str = ""


class ZenohNodeStatus(msgspec.Struct, frozen=True):
    """A node of rmw_zenoh; ``address`` is empty if the node is beyond a router outside."""

    name: str = ""
    domain: Count = 0
    address: str = ""
    publishes: Names = ()
    subscribes: Names = ()
    services: Names = ()
    left_out: Count = 0


class ZenohStatus(msgspec.Struct, frozen=True):
    """The routers for rmw_zenoh: ports for containers, and the port ``listen`` for outside.

    ``failure``: why the routers do not run. ``restarts``: how often they have ended.
    """

    ports: str = ""
    listen: Count | None = None
    failure: str = ""
    restarts: Count = 0
    links: tuple[ZenohLinkStatus, ...] = ()
    sessions: tuple[ZenohSessionStatus, ...] = ()
    nodes: tuple[ZenohNodeStatus, ...] = ()
    left_out: Count = 0


class ProxyStatus(msgspec.Struct, frozen=True):
    """Everything that a proxy tells of itself.

    ``instance`` differs after each start; ``retired``: it registers nothing any more;
    ``range_probe`` is None before the first try; ``stand_ins`` are the ports that stand in for
    nodes outside; ``udpros`` the subscriptions by UDPROS; ``domains`` those of ROS 2; ``zenoh`` the
    routers for rmw_zenoh, None without any.
    """

    version: str = ""
    pid: Count = 0
    instance: str = ""
    retired: bool = False
    uptime: Seconds = 0.0
    settings: StatusSettings = StatusSettings()
    master: MasterStatus = MasterStatus()
    ports: PortsStatus = PortsStatus()
    range_probe: RangeProbeStatus | None = None
    data_plane: DataPlaneStatus | None = None
    stand_ins: tuple[StandInStatus, ...] = ()
    udpros: tuple[UdprosStatus, ...] = ()
    policy: PolicyStatus | None = None
    nodes: tuple[EndpointStatus, ...] = ()
    domains: tuple[DomainStatus, ...] = ()
    zenoh: ZenohStatus | None = None
    problems: tuple[ProblemStatus, ...] = ()
    left_out: Count = 0


def parse_status(text: str | bytes) -> ProxyStatus:
    """The status in the text of an answer. Raises NotAStatus if that is not a rosproxy's."""
    try:
        document = json.loads(text)
    except (ValueError, RecursionError):
        document = None
    if not isinstance(document, dict) or "settings" not in document:
        raise NotAStatus("not the status of a rosproxy")
    return read_status(document)


def read_status(document: object) -> ProxyStatus:
    """The status in decoded JSON. Raises NotAStatus if it has more than MOST_ROWS objects."""
    if _has_too_many_rows(document):
        raise NotAStatus(f"a status of more than {MOST_ROWS} objects")
    return _convert_leniently(document, ProxyStatus)


def _has_too_many_rows(document: object) -> bool:
    rows = 0
    pending = [document]
    while pending:
        value = pending.pop()
        if isinstance(value, dict):
            rows += 1
            if rows > MOST_ROWS:
                return True
            pending.extend(value.values())
        elif isinstance(value, list):
            pending.extend(value)
    return False


def to_json(document: msgspec.Struct) -> dict[str, Any]:
    """A document as plain data to be encoded as JSON."""
    plain: dict[str, Any] = msgspec.to_builtins(document)
    return plain


def _convert_leniently(value: object, kind: type[Document]) -> Document:
    """A document with defaults in place of what does not fit."""
    # Nearly always all of it fits, and one step in C is enough.
    try:
        return msgspec.convert(value, kind)
    except _UNFIT:
        raw_fields = value if isinstance(value, dict) else {}
    fields = {}
    for field in _fields(kind):
        with suppress(KeyError, *_UNFIT):
            fields[field.name] = _convert_field(raw_fields[field.encode_name], field.type)
    return kind(**fields)


_fields = cache(msgspec.structs.fields)
"""The fields of a struct: to find them takes a hundred times as long as to convert one."""


def _convert_field(value: Any, kind: Any) -> Any:
    """A value as a field's type; lists are of structs or of texts. Raises ValidationError."""
    inner = get_args(kind)[0] if get_origin(kind) in (UnionType, tuple) else kind
    is_struct = isinstance(inner, type) and issubclass(inner, msgspec.Struct)
    if is_struct and isinstance(value, dict) and get_origin(kind) is not tuple:
        return _convert_leniently(value, inner)
    if get_origin(kind) is not tuple or not isinstance(value, list):
        return msgspec.convert(value, kind)
    items = [item for item in value if isinstance(item, dict if is_struct else str)]
    return tuple(_convert_leniently(item, inner) if is_struct else item for item in items)
