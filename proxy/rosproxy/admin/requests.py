"""The bodies of the admin endpoint's POST calls, and of their answers.

Each body is a type; it is made from decoded JSON, or a BodyError says in one line which field is
wrong and what it must be. Addresses come out in their plain form and host names in lower case.
"""

import re
from typing import TypeVar

import msgspec

from rosproxy.access.layers import WrittenLayer
from rosproxy.net.addresses import HostPort, parse_address
from rosproxy.setting_kinds import read_peer
from rosproxy.telemetry.text import clean, shorten

Body = TypeVar("Body", bound=msgspec.Struct)
# Not the narrower rule of DNS: names of containers have underscores as well.
_NAME = re.compile(r"[\w.-]{1,253}")
_PREFIX = re.compile(r"[0-9a-f]{2}(\.[0-9a-f]{2}){11}")
"""A GUID prefix as `/status` writes it."""
MOST_PEERS = 1024
"""Peers that a proxy can be told of: each is told of every participant inside."""
_LONGEST = 150
"""Characters of a message: it repeats what was sent."""


class BodyError(ValueError):
    """A body that can't be used; the message names the field and says what it must be."""


class EmptyBody(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The body of ``POST /probe`` and ``POST /retire``: none, or an empty object."""


class MasterAddress(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The body of ``POST /master-address``: where the master is looked for from now on."""

    address: str

    def __post_init__(self) -> None:
        msgspec.structs.force_setattr(self, "address", _address("address", self.address))


class ArrivedContainer(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A container on an inside network: its IP address there, and the host names it goes by."""

    address: str
    names: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        for name in self.names:
            if not _NAME.fullmatch(name):
                raise ValueError(f"names: must be host names, not {name[:40]!r}")
        msgspec.structs.force_setattr(self, "address", _address("address", self.address))
        msgspec.structs.force_setattr(self, "names", frozenset(map(str.lower, self.names)))


class ContainerUpdate(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The body of ``POST /containers``: what has become of containers.

    ``gone``: addresses that no container has any more. ``moved``: old address to new address.
    ``arrived``: containers that may have nodes which registered before the proxy was there.
    ``selected``: the addresses that may use the proxy as their master; None: unchanged.
    ``peers`` are those of ROS 2, ``host`` or ``host:port``, instead of all before; None: unchanged.
    ``former``: the ports, by GUID prefix, that participants had at a proxy with another address, or
    with another range.
    """

    gone: tuple[str, ...] = ()
    moved: dict[str, str] = {}
    arrived: tuple[ArrivedContainer, ...] = ()
    selected: tuple[str, ...] | None = None
    peers: tuple[str, ...] | None = None
    former: dict[str, tuple[int, ...]] = {}

    @property
    def former_ports(self) -> dict[bytes, tuple[int, ...]]:
        """``former`` by the bytes of the prefix."""
        return {bytes.fromhex(text.replace(".", "")): ports for text, ports in self.former.items()}

    @property
    def ros2_peers(self) -> tuple[HostPort, ...] | None:
        """The peers, parsed."""
        return None if self.peers is None else tuple(map(read_peer, self.peers))

    @property
    def tells_events(self) -> bool:
        """Whether it tells of anything that has happened to a container."""
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
    """The body of ``POST /policy``: the layers of rules that replace those told before."""

    layers: tuple[WrittenLayer, ...]


class EnforcementCounts(msgspec.Struct, frozen=True):
    """What a change of the policy led to: registrations hidden and shown, connections cut."""

    hidden: int = 0
    shown: int = 0
    cut: int = 0


class PortProbe(msgspec.Struct, frozen=True):
    """How a port of the range was reached, by the proxy itself and by the master.

    ``from_proxy`` is ok, refused, silent, unreachable, unresolvable, closed (taken, but not passed
    on to the proxy) or stranger (something else answers); ``from_master`` is ok, missed (the
    master's call did not arrive) or unknown (the master could not be asked). ``transport`` is tcp,
    or for ROS 2 udp, where nobody but the proxy itself can try.
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
    """The answer to ``POST /probe``; an empty one if it is of no use."""
    try:
        return msgspec.convert(answer, RangeProbe)
    except msgspec.ValidationError:
        return RangeProbe()


def read_body(body: object, kind: type[Body]) -> Body:
    """A decoded body as its type. Raises BodyError."""
    try:
        return msgspec.convert(body, kind)
    except msgspec.ValidationError as error:
        # For example: Expected `str`, got `int` - at `$.gone[0]`. A ValueError of __post_init__ is
        # its cause and has named the field already.
        fault, _, path = str(error).partition(" - at `$")
        field = path.removeprefix(".").removesuffix("`")
        if error.__cause__ is None:  # msgspec's own, which does not begin with a field
            hint = "" if field else f"; known: {', '.join(kind.__struct_fields__) or 'none'}"
            text = f"{field or 'the body'}: {fault}" + (hint if "unknown field" in fault else "")
        else:
            text = f"{field}.{fault}" if field else fault
        raise BodyError(shorten(clean(text), _LONGEST)) from None


def _address(field: str, text: str) -> str:
    address = parse_address(text)
    if address is None:
        raise ValueError(f"{field}: must be an IP address such as 172.18.0.5, not {text[:40]!r}")
    return address
