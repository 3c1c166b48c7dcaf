"""The document at ``/status``: one definition for the proxy and for all readers.

`rosproxy.admin.common_status` makes the common part. ``rosproxy status``, ``rosproxy doctor`` and
the operator read the document with `parse_status` (text of an answer) or `read_status` (decoded
JSON). ROS nodes choose the names in the document, and the document may come from another version of
the proxy. So readers are tolerant: they ignore unknown keys, and use the default for a missing
value or a value of another type. Texts may have control characters. The proxy bounds the document
(`rosproxy.shared.documents.status_bounds`), and ``left_out`` counts the missing entries. A document
of another version may be longer.

Times are in seconds, rates in bytes per second. ``sent`` are bytes from inside to outside,
``received`` bytes from outside to inside.
"""

import json
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from types import UnionType
from typing import Annotated, Any, TypeVar, get_args, get_origin

import msgspec

# json.loads accepts NaN, Infinity and integers of any length. These bounds exclude all three.
# 2**63 - 1 is the largest bound that msgspec accepts.
Count = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
Seconds = Annotated[float, msgspec.Meta(ge=0, le=1e15)]
Rate = Annotated[float, msgspec.Meta(ge=0, le=1e18)]
Names = tuple[str, ...]
Document = TypeVar("Document", bound=msgspec.Struct)
MOST_ROWS = 50_000
"""JSON objects at most in a document that a reader accepts.

An object in a status has 21 bytes at least, so a status of 1 MiB has fewer objects.
"""
MOST_MISFITS = 1000
"""JSON objects at most that a reader converts value by value, which takes 25 us each.

In a status with more objects of which a value does not fit, the reader leaves out the rest of their
lists. Another version of the proxy may have such objects, and an attacker that controls the proxy.
"""


# msgspec raises UnicodeEncodeError for half of a surrogate pair, which json.loads accepts.
_UNFIT = (msgspec.ValidationError, UnicodeEncodeError)


class NotAStatus(ValueError):
    """The text or JSON is not the status of a rosproxy."""


class StatusSettings(msgspec.Struct, frozen=True):
    """The settings of the proxy that other programs have to know.

    ``ros``: the versions of ROS. ``inside_networks``: the inside networks in force, as CIDRs.
    ``direction``: ``out``, or ``both`` if inside reaches outside through the proxy, too.
    ``udp``: the proxy forwards UDPROS from publishers outside. ``selected``: the number of
    addresses that an operator has selected; None: no operator has selected addresses yet.
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
        """Whether the proxy serves ROS 1."""
        return "1" in self.ros


class MasterStatus(msgspec.Struct, frozen=True):
    """The real master. ``pinned``: an option or the operator sets ``address``, not the host name.

    Neither ``up`` nor an ``error``: the proxy has not asked the master yet. ``since``: the age of
    this state.
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
    """The listen range and the advertised range, each as ``A-B``, and numbers of ports.

    ``blocked``: ports that other programs hold. ``held_by``: other proxies on this machine whose
    range has some of these ports.
    """

    listen: str = ""
    advertise: str = ""
    used: Count = 0
    free: Count = 0
    blocked: Count = 0
    held_by: Names = ()


class RangeProbeStatus(msgspec.Struct, frozen=True):
    """The worst result of the last try to reach ports of the range, ``age`` seconds ago.

    ``reached``: outside reaches the ports; None: unknown. `PortProbe` explains the other fields.
    """

    reached: bool | None = None
    from_proxy: str = ""
    from_master: str = ""
    transport: str = ""
    age: Seconds = 0.0


class DataPlaneStatus(msgspec.Struct, frozen=True):
    """The setting ``mode``, and the ``plane`` in use. ``reason``: why the kernel is not in use."""

    mode: str = ""
    plane: str = ""
    reason: str = ""


class NodePlaneStatus(msgspec.Struct, frozen=True):
    """What the kernel forwards through the fast ``port`` of a node or stand-in.

    ``reason``: why the kernel does not forward. ``sent`` and ``received`` count the bytes of IP
    packets.
    """

    plane: str = ""
    port: Count | None = None
    reason: str | None = None
    connections: Count = 0
    sent: Count = 0
    received: Count = 0
    sent_rate: Rate = 0.0
    received_rate: Rate = 0.0


class StandInStatus(msgspec.Struct, frozen=True):
    """A stand-in: the ``port`` through which inside reaches the node or service at ``uri``.

    ``connections`` and rates are the sums of the proxy and of the kernel (``data_plane``).
    """

    port: Count = 0
    uri: str = ""
    connections: Count = 0
    sent_rate: Rate = 0.0
    received_rate: Rate = 0.0
    data_plane: NodePlaneStatus | None = None


class UdprosStatus(msgspec.Struct, frozen=True):
    """A UDPROS subscription that the proxy forwards.

    ``port`` is the UDP port of the proxy. ``inward``: the subscriber is inside. ``bytes``:
    forwarded bytes. ``dropped``: datagrams from other sources than the publisher.
    """

    topic: str = ""
    caller_id: str = ""
    peer: str = ""
    port: Count = 0
    inward: bool = False
    bytes: Count = 0
    dropped: Count = 0


class ConnectionStatus(msgspec.Struct, frozen=True):
    """A relayed TCPROS connection. ``kind``: topic or service. ``peer``: the source outside."""

    kind: str = ""
    name: str = ""
    caller_id: str = ""
    peer: str = ""
    sent: Count = 0
    received: Count = 0
    sent_rate: Rate = 0.0
    received_rate: Rate = 0.0


class EndpointStatus(msgspec.Struct, frozen=True):
    """An endpoint of ROS 1, with all registrations of a slave URI: usually a single node.

    ``nodes``: the names of the nodes; nodelets share a slave URI. ``uri``: the slave URI that the
    node has given. ``address``: the address at which the proxy reaches the node.
    ``state`` is a member of `rosproxy.ros1.registry.endpoint.STATES`. ``unanswered``: the seconds
    since the first of the last failed probes; 0 if the node answers.
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
    unanswered: Seconds = 0.0

    @property
    def given_up(self) -> bool:
        """Whether the proxy counts the nodes as gone: cleaned up, or ended with the container."""
        return self.state == "cleaned" or self.has_ended

    @property
    def has_ended(self) -> bool:
        """Whether an operator has reported the end of the container, which is no fault."""
        return self.state == "ended"


class LayerStatus(msgspec.Struct, frozen=True):
    """A layer of rules in force. ``addresses``: the number of addresses inside; None: all."""

    name: str = ""
    mode: str = ""
    rules: Names = ()
    addresses: Count | None = None
    left_out: Count = 0


class HiddenStatus(msgspec.Struct, frozen=True):
    """A name that the policy hides. ``reason``: layer and rule; ``address``: that of the node."""

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
    """A problem that was last noted ``age`` seconds ago, and first ``known_for`` seconds ago.

    ``holds``: lasts until it is solved.
    """

    age: Seconds = 0.0
    subject: str = ""
    text: str = ""
    holds: bool = False
    known_for: Seconds = 0.0


class LocatorStatus(msgspec.Struct, frozen=True):
    """A port of the proxy, and the locator ``where`` to which the port leads.

    ``kind`` is metatraffic or data. ``plane``: proxy or kernel forwards; ``reason``: why not the
    kernel. ``datagrams`` and ``bytes`` count what the proxy has forwarded, ``kernel_datagrams`` and
    ``kernel_bytes`` the IP packets that the kernel has forwarded. ``user_datagrams`` counts
    user data: of the proxy, datagrams with samples; of the kernel, all. ``user_rate`` is in bytes,
    ``user_datagram_rate`` in datagrams per second.
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
    user_datagrams: Count = 0
    user_rate: Rate = 0.0
    user_datagram_rate: Rate = 0.0


class NamedTypeStatus(msgspec.Struct, frozen=True):
    """A topic or service with the type that a participant announces."""

    name: str = ""
    type: str = ""


class ParticipantStatus(msgspec.Struct, frozen=True):
    """A participant of ROS 2, inside or outside, with the announced topics and services.

    ``leases``: for a participant inside, the port mappings; for a participant outside, the
    stand-ins. ``kept``: a participant inside remembers its ports for the next process of the proxy.
    ``proven``: a participant outside reaches ports of the range, or the proxy does not know yet.
    ``problem``: what the participant lacks. ``domain``: the announced domain. ``types``: the types
    of the topics and services. ``nodes``: the ROS nodes that the services of each node name.
    `rosproxy.ros2.registry.participants` has the values of ``security``, ``locator_fault`` and
    ``shortage``, which is the kind of ``problem``.
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
    nodes: Names = ()


class MismatchStatus(msgspec.Struct, frozen=True):
    """A topic or service (``kind``) whose reader and writer on the two sides do not match.

    ``policy``: the first QoS policy, the type, or the type hash, that differs. ``offered``: the
    value of the writer. ``requested``: the value of the reader. ``writer`` and ``reader`` are GUID
    prefixes, or keys of nodes of rmw_zenoh (`ZenohStatus`).
    """

    kind: str = ""
    name: str = ""
    policy: str = ""
    offered: str = ""
    requested: str = ""
    writer: str = ""
    reader: str = ""


class DomainStatus(msgspec.Struct, frozen=True):
    """A domain of ROS 2: participants, counts of datagrams, and mismatches.

    ``discovery``: the address at which the proxy receives discovery from outside. ``direction``:
    the setting of the proxy. ``dropped``: refused datagrams. ``lost``: datagrams that the kernel
    did not accept. ``overflowed``: datagrams that the kernel dropped because a receive buffer of
    the proxy was full; ``overflowed_recently`` counts the last minute. ``receive_buffer``: the size
    of these buffers in bytes. ``data_plane`` is for user data. ``not_compared``: pairs of a reader
    and a writer that the proxy has not compared. ``unselected``: addresses inside that have
    announced participants, but that the operator has not selected.
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
    overflowed: Count = 0
    overflowed_recently: Count = 0
    receive_buffer: Count = 0
    data_plane: DataPlaneStatus | None = None
    inside: tuple[ParticipantStatus, ...] = ()
    outside: tuple[ParticipantStatus, ...] = ()
    unselected: Names = ()
    mismatches: tuple[MismatchStatus, ...] = ()
    mismatches_left_out: Count = 0
    not_compared: Count = 0
    left_out: Count = 0


class ZenohLinkStatus(msgspec.Struct, frozen=True):
    """A link to the router outside at ``peer``. ``since``: the age of this state.

    ``error``: why the link is not up, a value of `rosproxy.zenoh.links.LinkFault`. ``hub``: the
    router is the hub of another proxy (``--zenoh-hub``), which may be away. ``protocol`` is tls or
    quic for a link to another site (``--zenoh-link``), otherwise tcp.
    """

    peer: str = ""
    up: bool = False
    error: str = ""
    since: Seconds = 0.0
    hub: bool = False
    protocol: str = "tcp"

    @property
    def title(self) -> str:
        """The peer, for a link to another site with the protocol."""
        return f"{self.protocol}/{self.peer}" if self.is_to_site else self.peer

    @property
    def is_to_site(self) -> bool:
        """Whether the link leads to the proxy of another site."""
        return self.protocol != "tcp"

    @property
    def is_to_router(self) -> bool:
        """Whether the link leads to a router outside (``--zenoh-peer``)."""
        return not self.hub and not self.is_to_site


class ZenohCertificateStatus(msgspec.Struct, frozen=True):
    """A file for links to other sites, and the time in which its certificate is valid.

    ``error``: why the file of now can't be used. ``starts_in``: the seconds until the certificate
    is valid. ``ends_in``: the seconds until its end, negative after the end; None for a key.
    ``hub``: the certificate of ``--zenoh-hub-certificate``, and ``file`` is the option.
    """

    file: str = ""
    error: str = ""
    starts_in: Seconds = 0.0
    ends_in: float | None = None
    hub: bool = False


class ZenohSessionStatus(msgspec.Struct, frozen=True):
    """A session of a router of the proxy: both addresses, and the ``mode`` of the other end.

    ``port``: the port of a router for containers; None: another router. ``mode``: client, peer or
    router. ``link``: the router is the one of the links to other sites. ``without_node``: how long
    the proxy has known no node of the session, or none behind the router at the other end. This is
    0 if a node is known, and for sessions that are not at a port for containers.
    """

    port: Count | None = None
    mode: str = ""
    zid: str = ""
    local: str = ""
    remote: str = ""
    link: bool = False
    without_node: Seconds = 0.0


class ZenohQosStatus(msgspec.Struct, frozen=True):
    """The QoS of a publisher or a subscription of a node. ``name``: the topic.

    ``kind`` is publisher or subscription. The other values are the names of ROS, as RELIABLE.
    """

    name: str = ""
    kind: str = ""
    reliability: str = ""
    durability: str = ""
    history: str = ""
    depth: Count = 0


class ZenohNodeStatus(msgspec.Struct, frozen=True):
    """A node of rmw_zenoh; ``address`` is empty if the node is beyond a router outside.

    ``port`` and ``mode`` are those of the node's session with a router of the proxy. ``port``: the
    port for containers; None: the node is outside. ``calls``: the services of which the node has a
    client. ``key`` is the same at all proxies, since several nodes may have the same name.
    ``not_judged``: the proxy has still to compare names of the node with the rules of the policy.
    ``qos``: of the node's publishers and subscriptions.
    """

    name: str = ""
    domain: Count = 0
    address: str = ""
    publishes: Names = ()
    subscribes: Names = ()
    services: Names = ()
    left_out: Count = 0
    calls: Names = ()
    types: tuple[NamedTypeStatus, ...] = ()
    port: Count | None = None
    mode: str = ""
    key: str = ""
    not_judged: bool = False
    qos: tuple[ZenohQosStatus, ...] = ()


class ZenohApartStatus(msgspec.Struct, frozen=True):
    """Nodes at an address that reach no other peers of their router, a ``router`` outside.

    ``nodes``: some of their names. ``since``: how long the proxy has known that. ``own_address``:
    the router knows the proxy by the same address, so the nodes run on the same host.
    """

    router: str = ""
    address: str = ""
    nodes: Names = ()
    own_address: bool = False
    since: Seconds = 0.0


class ZenohFullStatus(msgspec.Struct, frozen=True):
    """A router of the proxy that refuses further sessions, at a ``port``.

    ``addresses``: those with the most of its ``sessions``. ``few_files``: the limit of open files
    allows no more sessions.
    """

    port: Count = 0
    sessions: Count = 0
    addresses: Names = ()
    few_files: bool = False


class ZenohUnlinkedStatus(msgspec.Struct, frozen=True):
    """A router of the proxy, at a ``port``, without a link to the hub for ``since`` seconds."""

    port: Count = 0
    since: Seconds = 0.0


class ZenohStatus(msgspec.Struct, frozen=True):
    """The routers for rmw_zenoh: ports for containers, and the port ``listen`` for outside.

    ``hub_listen``: the port of the hub for the hubs of other proxies.
    ``failure``: why the routers do not run. ``restarts``: how often the child process has ended.
    ``mismatches`` are pairs of nodes with a node inside: ``writer`` is the key of the node that
    publishes or serves, ``reader`` of the node that subscribes or calls. ``not_compared``: pairs of
    nodes that the proxy has not compared. ``link_listen``: the port for links of other sites, such
    as ``tls/7447``; ``link_listens``: whether this port accepts connections. ``limits``: the rates
    of topics on links to other sites, as ``/camera/*=2Hz``. ``apart``: zenoh peers of routers
    outside that do not reach each other. ``full``: the routers that refuse further sessions.
    ``unlinked``: the other routers to which the hub has no link.
    """

    ports: str = ""
    listen: Count | None = None
    link_listen: str = ""
    link_listens: bool = True
    limits: tuple[str, ...] = ()
    certificates: tuple[ZenohCertificateStatus, ...] = ()
    failure: str = ""
    restarts: Count = 0
    links: tuple[ZenohLinkStatus, ...] = ()
    sessions: tuple[ZenohSessionStatus, ...] = ()
    nodes: tuple[ZenohNodeStatus, ...] = ()
    left_out: Count = 0
    mismatches: tuple[MismatchStatus, ...] = ()
    mismatches_left_out: Count = 0
    not_compared: Count = 0
    hub_listen: Count | None = None
    apart: tuple[ZenohApartStatus, ...] = ()
    full: tuple[ZenohFullStatus, ...] = ()
    unlinked: tuple[ZenohUnlinkedStatus, ...] = ()


class ProxyStatus(msgspec.Struct, frozen=True):
    """The whole status of a proxy.

    ``instance`` differs after each start. ``retired``: the proxy registers nothing any more.
    ``range_probe`` is None before the first try. ``stand_ins`` are of ROS 1, ``domains`` of ROS 2.
    ``zenoh``: the routers for rmw_zenoh; None without routers.
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
    """The status in the text of an answer.

    Raises NotAStatus for the text of another program, and for more than MOST_ROWS objects.
    """
    try:
        document = json.loads(text)
    except (ValueError, RecursionError):
        document = None
    if not isinstance(document, dict) or "settings" not in document:
        raise NotAStatus("not the status of a rosproxy")
    return read_status(document)


def read_status(document: object) -> ProxyStatus:
    """The status in decoded JSON, with defaults for all that does not fit.

    Raises NotAStatus for more than MOST_ROWS objects.
    """
    if _has_too_many_rows(document):
        raise NotAStatus(f"a status of more than {MOST_ROWS} objects")
    return _LenientReader().convert(document, ProxyStatus)


def _has_too_many_rows(document: object) -> bool:
    rows = 0
    pending: list[Any] = [[document]]
    while pending:
        value = pending.pop()
        if isinstance(value, dict):
            rows += 1
            if rows > MOST_ROWS:
                return True
            value = value.values()
        pending += [inner for inner in value if isinstance(inner, dict | list)]
    return False


def to_json(document: msgspec.Struct) -> dict[str, Any]:
    """A document as dicts, lists and plain values, ready for JSON."""
    plain: dict[str, Any] = msgspec.to_builtins(document)
    return plain


class _LenientReader:
    """Converts a document. A value that does not fit becomes the default of the field."""

    def __init__(self) -> None:
        self._misfits = 0

    def convert(self, value: object, kind: type[Document]) -> Document:
        """The struct of an object; the default if the value is no object."""
        # Nearly always everything fits, and a single call of C code is enough.
        try:
            return msgspec.convert(value, kind)
        except _UNFIT:
            raw_fields = value if isinstance(value, dict) else {}
        self._misfits += 1
        fields = {}
        for field in _fields(kind):
            with suppress(KeyError, *_UNFIT):
                fields[field.name] = self._field(raw_fields[field.encode_name], field.type)
        return kind(**fields)

    def _field(self, value: Any, kind: Any) -> Any:
        """Convert a value to the type of a field. Raises ValidationError, UnicodeEncodeError.

        Lists keep the items of the right kind: structs or texts.
        """
        inner = get_args(kind)[0] if get_origin(kind) in (UnionType, tuple) else kind
        is_struct = isinstance(inner, type) and issubclass(inner, msgspec.Struct)
        if is_struct and isinstance(value, dict) and get_origin(kind) is not tuple:
            return self.convert(value, inner)
        if get_origin(kind) is not tuple or not isinstance(value, list):
            return msgspec.convert(value, kind)
        if is_struct:
            return tuple(self._structs(value, inner))
        return tuple(item for item in value if isinstance(item, str))

    def _structs(self, items: list[Any], kind: type[Document]) -> Iterator[Document]:
        for item in items:
            if self._misfits >= MOST_MISFITS:
                return
            if isinstance(item, dict):
                yield self.convert(item, kind)


_fields = cache(msgspec.structs.fields)
"""The fields of a struct. Without the cache, this call takes as long as a hundred conversions."""
