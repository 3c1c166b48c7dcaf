"""Options: what is told of each, what kinds of values there are, and how they are read from a text.

``read_…`` raises ValueError, whose message says what is wrong with the text and gives an example.
"""

import hashlib
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from inspect import Parameter, signature
from ipaddress import ip_address, ip_network
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    TypeVar,
    get_args,
    get_origin,
    get_type_hints,
)

from rosproxy.access.layers import PolicyLayer, read_layers
from rosproxy.access.rules import parse_rules
from rosproxy.leases.ports import PortRange
from rosproxy.net import addresses
from rosproxy.net.addresses import HostPort, Network, parse_host_port

DataPlane = Literal["auto", "kernel", "splice", "copy"]
"""How topics' bytes are forwarded: by the kernel, spliced, or copied; auto: the best possible."""
Direction = Literal["out", "both"]
"""Who reaches the other side through the proxy: outside alone, or the nodes inside, too."""
SlaveControl = Literal["any", "master"]
"""Who may call shutdown, publisherUpdate and paramUpdate at inside nodes."""
DAY = 86400
ZENOH_PORT = 7447
"""The port at which rmw_zenohd listens by default."""
_RANGE = re.compile(r"\s*([0-9]{1,5})\s*-\s*([0-9]{1,5})\s*")
_TOKEN = re.compile(r"[!-~]{8,200}")
_HASH = re.compile(r"[0-9a-f]{64}")
_LONGEST = 40
"""Characters of a bad value that a message repeats."""
_Value = TypeVar("_Value")


@dataclass(frozen=True, slots=True)
class Text:
    """A kind of value that ``read`` makes of a text. Help calls it ``form``.

    ``separable``: where several may be given, spaces in a variable separate them.
    """

    form: str
    read: Callable[[str], Any]
    separable: bool = True


@dataclass(frozen=True, slots=True)
class Number:
    """An integer, or with ``seconds`` a time, within bounds. Help calls it ``form``."""

    form: str
    least: float
    most: float
    seconds: bool = False


@dataclass(frozen=True, slots=True)
class Option:
    """How a setting is given.

    ``help`` is what it means, in Markdown; command lines show it without marks and links. ``kind``
    says what its texts are; without one, its type does: a flag, or one of several words. ``name``
    is that on the command line and ``variables`` those of the environment where they are not made
    of the field's. ``repeatable``: several may be given. ``default`` tells what is done without it,
    where its value does not. ``note`` tells how several are written in the variable.
    """

    help: str
    kind: Text | Number | None = None
    name: str = ""
    variables: tuple[str, ...] = ()
    repeatable: bool = False
    default: str = ""
    note: str = ""


class Setting(NamedTuple):
    """A field that is annotated with an `Option`; ``words``: those that it may be."""

    field: str
    option: Option
    default: Any
    words: tuple[str, ...]

    @property
    def required(self) -> bool:
        """Whether it has to be given."""
        return self.default is None and not self.option.default

    @property
    def name(self) -> str:
        """What it is called on the command line."""
        return self.option.name or f"--{self.field.replace('_', '-')}"

    @property
    def variables(self) -> tuple[str, ...]:
        """The variables of the environment that give it."""
        return self.option.variables or (f"ROSPROXY_{self.parameter.upper()}",)

    @property
    def parameter(self) -> str:
        """The same as a name in Python."""
        return self.name.removeprefix("--").replace("-", "_")


def declared(settings: type) -> list[Setting]:
    """The settings of a dataclass or struct, in its order; a field without an `Option` is none."""
    hints = get_type_hints(settings, include_extras=True)
    parameters = signature(settings).parameters
    return [
        _setting(name, hints[name], parameter.default)
        for name, parameter in parameters.items()
        if get_origin(hints[name]) is Annotated
    ]


def make_settings(settings: type[_Value], given: Mapping[str, Any], **other: Any) -> _Value:
    """The settings of what was given for their options, and of ``other`` fields."""
    by_field = {setting.field: given[setting.parameter] for setting in declared(settings)}
    values = {field: value for field, value in by_field.items() if value is not None}
    return settings(**values, **other)


def _setting(field: str, hint: Any, default: Any) -> Setting:
    kind, option = get_args(hint)
    if get_origin(kind) is tuple:
        kind = get_args(kind)[0]
    words = get_args(kind) if get_origin(kind) is Literal else ()
    return Setting(field, option, None if default is Parameter.empty else default, words)


class SettingError(ValueError):
    """A setting that can't be used. ``option`` names it as on the command line."""

    def __init__(self, option: str, problem: str) -> None:
        super().__init__(f"{option}: {problem}")
        self.option = option


def time(least: float) -> Number:
    """A time of at most a day."""
    return Number("S", least, DAY, seconds=True)


def read_range(text: str) -> PortRange:
    """A range of ports, ``first-last``. Raises ValueError."""
    match = _RANGE.fullmatch(text)
    if match is None:
        raise ValueError(f"{text[:_LONGEST]!r} is not a range such as 11000-11099")
    ports = PortRange(int(match[1]), int(match[2]))
    if not 1 <= ports.first <= ports.last <= 65535:
        message = f"{text!r} must rise and stay between 1 and 65535, such as 11000-11099"
        raise ValueError(message)
    return ports


def read_host(text: str) -> str:
    """A host name or address, which comes out without brackets. Raises ValueError."""
    bare = text.strip("[]")
    if parse_host_port(f"[{bare}]:1" if ":" in bare else f"{bare}:1") != HostPort(bare, 1):
        raise ValueError(
            f"{text[:_LONGEST]!r} is neither a host name nor an address such as 192.0.2.7"
        )
    return bare


def read_address(text: str) -> str | None:
    """An IP address in its plain form; None for no text. Raises ValueError."""
    address = addresses.parse_address(text)
    if text and address is None:
        raise ValueError(f"{text[:_LONGEST]!r} is not an IP address such as 192.0.2.7")
    return address


def read_bind_address(text: str) -> str:
    """An IP address to listen on, also the unspecified one. Raises ValueError."""
    try:
        return str(ip_address(text))
    except ValueError:
        message = f"{text[:_LONGEST]!r} is not an IP address of this host, such as 0.0.0.0"
        raise ValueError(message) from None


def read_host_port(text: str, example: str = "127.0.0.1:11312") -> HostPort:
    """``host:port`` or ``[v6]:port``. Raises ValueError."""
    target = parse_host_port(text)
    if target is None:
        raise ValueError(f"{text[:_LONGEST]!r} is not of the form {example}")
    return target


def read_peer(text: str) -> HostPort:
    """A peer of ROS 2: a host, or ``host:port``; without a port it is 0. Raises ValueError."""
    try:
        return HostPort(read_host(text), 0)
    except ValueError:
        return read_host_port(text, "HOST or HOST:PORT, such as robot or 192.0.2.7:11400")


def read_zenoh_peer(text: str) -> HostPort:
    """A zenoh router: a host, or ``host:port``; without a port 7447. Raises ValueError."""
    try:
        return HostPort(read_host(text), ZENOH_PORT)
    except ValueError:
        return read_host_port(text, "HOST or HOST:PORT, such as robot or 192.0.2.7:7447")


def read_network(text: str) -> Network:
    """A network as CIDR. Raises ValueError."""
    try:
        return ip_network(text)
    except ValueError as error:
        message = f"{text[:_LONGEST]!r} is not a network such as 172.18.0.0/16: {error}"
        raise ValueError(message) from None


def read_master_uri(text: str) -> str:
    """The URI of a ROS master. Raises ValueError."""
    if not text.startswith("http://") or addresses.parse_authority(text) is None:
        raise ValueError(f"{text[:_LONGEST]!r} is not of the form http://host:11311")
    return text


def read_token(text: str) -> str | None:
    """What travels in a header: printable ASCII without spaces; None for no text.

    Raises ValueError, which does not repeat it.
    """
    if text and not _TOKEN.fullmatch(text):
        raise ValueError(
            "must be 8 to 200 letters, digits or signs without spaces, for example the output of "
            "openssl rand -hex 16"
        )
    return text or None


def read_token_hash(text: str) -> str | None:
    """A SHA-256 in hex digits, in lower case; None for no text. Raises ValueError."""
    digits = text.strip().lower()
    if digits and not _HASH.fullmatch(digits):
        raise ValueError(
            'must be the 64 hex digits of a SHA-256; printf %s "$TOKEN" | sha256sum prints them'
        )
    return digits or None


def read_policy_layers(text: str) -> tuple[PolicyLayer, ...]:
    """The layers of a policy as JSON; none for no text. Raises ValueError."""
    try:
        return read_layers(json.loads(text)) if text.strip() else ()
    except RecursionError:
        raise ValueError("the JSON is nested too deeply") from None


def hash_token(token: str) -> str:
    """The SHA-256 of a token, in 64 hex digits, as ``--admin-token-hash`` takes it."""
    return hashlib.sha256(token.encode()).hexdigest()


def parse_range(option: str, text: str) -> PortRange:
    """Like `read_range`. Raises SettingError that names ``option``."""
    return _named(option, read_range, text)


def parse_host(option: str, text: str) -> str:
    """Like `read_host`. Raises SettingError that names ``option``."""
    return _named(option, read_host, text)


def _named(option: str, read: Callable[[str], _Value], text: str) -> _Value:
    try:
        return read(text)
    except ValueError as error:
        raise SettingError(option, str(error)) from None


def host_port(example: HostPort) -> Text:
    """``host:port``, for which a message gives an example."""
    return Text("ADDRESS:PORT", lambda text: read_host_port(text, str(example)))


PORT = Number("PORT", 1, 65535)
MEBIBYTES = Number("MiB", 1, 65536)
CONNECTIONS = Number("N", 16, 1_000_000)
# RTPS's ports of a domain begin at 7400 + 250 * ID: those of 233 would exceed 65535.
DOMAIN = Number("ID", 0, 232)
PORT_RANGE = Text("A-B", read_range)
HOST = Text("HOST", read_host)
ADDRESS = Text("ADDRESS", read_address)
BIND_ADDRESS = Text("ADDRESS", read_bind_address)
HOST_PORT = Text("ADDRESS:PORT", read_host_port)
PEER = Text("HOST[:PORT]", read_peer)
ZENOH_PEER = Text("HOST[:PORT]", read_zenoh_peer)
NETWORK = Text("CIDR", read_network)
MASTER_URI = Text("URI", read_master_uri)
TOKEN = Text("TOKEN", read_token)
TOKEN_HASH = Text("HASH", read_token_hash)
POLICY_RULES = Text("RULES", parse_rules, separable=False)
POLICY_LAYERS = Text("JSON", read_policy_layers)
FILE = Text("FILE", str)
