"""The bodies of the POST calls of the admin endpoint, and of the answers.

Each body has a type. `read_body` converts decoded JSON, or raises a BodyError, which names the
wrong field and the expected value in a line. Addresses get the form of `parse_address`, and host
names become lower case.
"""

import re
from typing import TypeVar

import msgspec

from rosproxy.shared.addresses import HostPort, parse_address
from rosproxy.shared.output.text import clean, shorten
from rosproxy.shared.policy.layers import WrittenLayer
from rosproxy.shared.setting_kinds import read_peer

Body = TypeVar("Body", bound=msgspec.Struct)
# Wider than the rule of DNS: names of containers may have underscores.
_NAME = re.compile(r"[\w.-]{1,253}")
_PREFIX = re.compile(r"[0-9a-f]{2}(\.[0-9a-f]{2}){11}")
"""A GUID prefix as `/status` writes it."""
MOST_PEERS = 1024
"""Peers of a proxy at most: the proxy sends each peer the announcements of all participants."""
_LONGEST_MESSAGE = 150
"""Characters of a message at most. The bound is needed: messages repeat texts of the body."""


class BodyError(ValueError):
    """A body with a wrong field; the message names the field and the expected value."""


class EmptyBody(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The body of ``POST /probe`` and ``POST /retire``: an empty object, or no body at all."""


class MasterAddress(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The body of ``POST /master-address``: the IP address of the master from now on."""

    address: str

    def __post_init__(self) -> None:
        msgspec.structs.force_setattr(self, "address", _address("address", self.address))


class ArrivedContainer(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A container on an inside network: the IP address there, and the host names."""

    address: str
    names: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        for name in self.names:
            if not _NAME.fullmatch(name):
                raise ValueError(f"names: must be host names, not {name[:40]!r}")
        msgspec.structs.force_setattr(self, "address", _address("address", self.address))
        msgspec.structs.force_setattr(self, "names", frozenset(map(str.lower, self.names)))


class ContainerUpdate(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The body of ``POST /containers``: changes of containers, callers and peers.

    ``gone``: addresses that no container has any more. ``moved``: new addresses by old addresses.
    ``arrived``: containers whose nodes may have registered before the start of the proxy.
    ``selected``: the addresses that may use the proxy as their master; None: unchanged.
    ``peers``: all peers of ROS 2, as ``host`` or ``host:port``; None: unchanged.
    ``former``: ports by GUID prefix. Participants had these ports at a proxy with another address
    or another range.
    """

    gone: tuple[str, ...] = ()
    moved: dict[str, str] = {}
    arrived: tuple[ArrivedContainer, ...] = ()
    selected: tuple[str, ...] | None = None
    peers: tuple[str, ...] | None = None
    former: dict[str, tuple[int, ...]] = {}

    @property
    def former_ports(self) -> dict[bytes, tuple[int, ...]]:
        """``former`` by GUID prefix, in bytes."""
        return {bytes.fromhex(text.replace(".", "")): ports for text, ports in self.former.items()}

    @property
    def ros2_peers(self) -> tuple[HostPort, ...] | None:
        """The parsed peers; None: unchanged."""
        return None if self.peers is None else tuple(map(read_peer, self.peers))

    @property
    def has_events(self) -> bool:
        """Whether a container has gone, moved or arrived."""
        return bool(self.gone or self.moved or self.arrived)

    def __post_init__(self) -> None:
        gone = tuple(_address(f"gone[{i}]", text) for i, text in enumerate(self.gone))
        moved = {
            _address("moved", old): _address(f"moved[{old[:40]!r}]", new)
            for old, new in self.moved.items()
        }
        msgspec.structs.force_setattr(self, "gone", gone)
        msgspec.structs.force_setattr(self, "moved", moved)
        for prefix in self.former:
            if not is_guid_prefix(prefix):
                raise ValueError(f"former: keys must be GUID prefixes, not {prefix[:40]!r}")
        if len(self.peers or ()) > MOST_PEERS:
            raise ValueError(f"peers: must be {MOST_PEERS} at most")
        for i, peer in enumerate(self.peers or ()):
            try:
                read_peer(peer)
            except ValueError as error:
                raise ValueError(f"peers[{i}]: {error}") from None
        if self.selected is not None:
            selected = (_address(f"selected[{i}]", text) for i, text in enumerate(self.selected))
            msgspec.structs.force_setattr(self, "selected", tuple(selected))


class PolicyUpdate(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The body of ``POST /policy``: all layers of the operator. They replace earlier layers."""

    layers: tuple[WrittenLayer, ...]


class EnforcementCounts(msgspec.Struct, frozen=True):
    """The effects of a policy change: registrations hidden and shown, connections cut."""

    hidden: int = 0
    shown: int = 0
    cut: int = 0


class PortProbe(msgspec.Struct, frozen=True):
    """The results when the proxy itself and the master tried to reach a port of the range.

    ``advertised``: the host and port at which outside should reach the port. ``from_proxy`` is ok,
    refused, silent, unreachable, unresolvable, closed (the connection is accepted, but does not
    reach the proxy) or stranger (another program answers). ``from_master`` is ok, missed (the call
    of the master did not arrive) or unknown (the master could not be asked). ``transport`` is tcp,
    or udp for ROS 2, where only the proxy itself can try.
    """

    port: int = 0
    advertised: str = ""
    from_proxy: str = ""
    from_master: str = ""
    transport: str = "tcp"


class RangeProbe(msgspec.Struct, frozen=True):
    """The answer to ``POST /probe``."""

    probes: tuple[PortProbe, ...] = ()


def is_guid_prefix(text: str) -> bool:
    """Whether a text is a GUID prefix, such as ``01.0f.45.d1.3c.00.a7.12.00.00.00.00``."""
    return _PREFIX.fullmatch(text) is not None


def read_probe(answer: object) -> RangeProbe:
    """The answer to ``POST /probe``; without probes if the answer has another form."""
    try:
        return msgspec.convert(answer, RangeProbe)
    except msgspec.ValidationError:
        return RangeProbe()


def read_body(body: object, kind: type[Body]) -> Body:
    """Convert a decoded body to its type. Raises BodyError."""
    try:
        return msgspec.convert(body, kind)
    except msgspec.ValidationError as error:
        # For example: Expected `str`, got `int` - at `$.gone[0]`. If __post_init__ has raised a
        # ValueError, that is the cause, and its message names the field.
        fault, _, path = str(error).partition(" - at `$")
        field = path.removeprefix(".").removesuffix("`")
        if error.__cause__ is None:  # a message of msgspec, which does not begin with the field
            hint = "" if field else f"; known: {', '.join(kind.__struct_fields__) or 'none'}"
            text = f"{field or 'the body'}: {fault}" + (hint if "unknown field" in fault else "")
        else:
            text = f"{field}.{fault}" if field else fault
        raise BodyError(shorten(clean(text), _LONGEST_MESSAGE)) from None


def _address(field: str, text: str) -> str:
    address = parse_address(text)
    if address is None:
        raise ValueError(f"{field}: must be an IP address such as 172.18.0.5, not {text[:40]!r}")
    return address
