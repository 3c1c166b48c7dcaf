"""Options: the description of an option, the kinds of values, and functions that parse values.

``read_…`` raises ValueError. The message says what is wrong with the text, and gives an example.
"""

import hashlib
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
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

from rosproxy.shared import addresses
from rosproxy.shared.addresses import HostPort, Network, parse_host_port
from rosproxy.shared.domain_ports import LAST_DOMAIN
from rosproxy.shared.policy.layers import PolicyLayer, read_layers
from rosproxy.shared.policy.rules import LONGEST_GLOB, parse_rules
from rosproxy.shared.ports import PortRange

DataPlane = Literal["auto", "kernel", "splice", "copy"]
"""How the bytes of topics are forwarded: by the kernel, by splice, by copies, or the best way."""
Direction = Literal["out", "both"]
"""Which side reaches the other through the proxy: out: outside reaches inside. both: both sides."""
SlaveControl = Literal["any", "master"]
"""Which callers outside may call shutdown, publisherUpdate and paramUpdate at inside nodes."""
LogLevel = Literal["debug", "info", "warning", "error"]
"""The lowest severity of messages in a log."""
DAY_S = 86400
ZENOH_PORT = 7447
"""The port at which rmw_zenohd listens by default."""
LINK_PROTOCOLS = ("tls", "quic")
"""The protocols of a link between sites."""
MOST_RATE_HZ = 10_000.0
LEAST_RATE_HZ = 0.001
_RANGE = re.compile(r"\s*([0-9]{1,5})\s*-\s*([0-9]{1,5})\s*")
_TOKEN = re.compile(r"[!-~]{8,200}")
_HASH = re.compile(r"[0-9a-f]{64}")
_PEM = re.compile(r"-----BEGIN ([A-Z ]{1,30})-----\s[A-Za-z0-9+/=\s]+-----END \1-----\n?")
_LONGEST_PEM = 32 * 1024
"""Characters of a text with certificates at most. Three long RSA keys need half of this."""
_LONGEST_QUOTE = 40
"""Characters of a bad value that a message repeats."""
_Value = TypeVar("_Value")


@dataclass(frozen=True, slots=True)
class Text:
    """A kind of value that ``read`` parses from a text. ``form`` is the name in help texts.

    ``separable``: spaces in an environment variable separate the values of a repeatable option.
    """

    form: str
    read: Callable[[str], Any]
    separable: bool = True


@dataclass(frozen=True, slots=True)
class Number:
    """An integer from ``least`` to ``most``; with ``seconds``, a time in seconds.

    ``form`` is the name in help texts.
    """

    form: str
    least: float
    most: float
    seconds: bool = False


@dataclass(frozen=True, slots=True)
class Option:
    """How a user gives a setting.

    ``help``: the meaning in Markdown; command lines show ``help`` without marks and links.
    ``kind``: the kind of the text; without a kind, the type of the field decides: a flag, or a
    choice of words. ``name``: the option on the command line; if empty, the name of the field
    decides. ``variables``: the environment variables; if empty, the name of the option decides.
    ``repeatable``: the option may occur several times. ``default``: the effect without the option,
    if the default value does not say so. ``note``: how to write several values in the variable.
    ``any_case``: a choice of words that may be in upper case, too.
    """

    help: str
    kind: Text | Number | None = None
    name: str = ""
    variables: tuple[str, ...] = ()
    repeatable: bool = False
    default: str = ""
    note: str = ""
    any_case: bool = False


class Setting(NamedTuple):
    """A field that is annotated with an `Option`. ``words``: the choices, if the type has any."""

    field: str
    option: Option
    default: Any
    words: tuple[str, ...]

    @property
    def required(self) -> bool:
        """Whether the user has to give the setting."""
        return self.default is None and not self.option.default

    @property
    def name(self) -> str:
        """The name of the option on the command line."""
        return self.option.name or f"--{self.field.replace('_', '-')}"

    @property
    def variables(self) -> tuple[str, ...]:
        """The environment variables of the setting."""
        return self.option.variables or (f"ROSPROXY_{self.parameter.upper()}",)

    @property
    def parameter(self) -> str:
        """The name of the option as a Python identifier."""
        return self.name.removeprefix("--").replace("-", "_")


def declared(settings: type) -> list[Setting]:
    """The settings of a dataclass or struct, in order: all fields with an `Option`."""
    hints = get_type_hints(settings, include_extras=True)
    parameters = signature(settings).parameters
    return [
        _setting(name, hints[name], parameter.default)
        for name, parameter in parameters.items()
        if get_origin(hints[name]) is Annotated
    ]


def make_settings(settings: type[_Value], given: Mapping[str, Any], **other: Any) -> _Value:
    """Make settings from the ``given`` values, by parameter, and from ``other`` fields.

    A field whose given value is None gets the default.
    """
    by_field = {setting.field: given[setting.parameter] for setting in declared(settings)}
    values = {field: value for field, value in by_field.items() if value is not None}
    return settings(**values, **other)


def _setting(field: str, hint: Any, default: Any) -> Setting:
    kind, option = get_args(hint)
    if get_origin(kind) is tuple:
        kind = get_args(kind)[0]
    words = get_args(kind) if get_origin(kind) is Literal else ()
    return Setting(field, option, None if default is Parameter.empty else default, words)


@dataclass(frozen=True, slots=True)
class SiteLink:
    """A proxy at another site, and the protocol of the link to this proxy: tls or quic."""

    protocol: str
    peer: HostPort

    def __str__(self) -> str:
        """``tls/host:port``, as zenoh writes an endpoint."""
        return f"{self.protocol}/{self.peer}"


@dataclass(frozen=True, slots=True)
class LinkPort:
    """The port at which the proxy accepts links of other sites, and the protocol."""

    protocol: str
    port: int

    def __str__(self) -> str:
        """``tls/port``."""
        return f"{self.protocol}/{self.port}"


@dataclass(frozen=True, slots=True)
class TopicLimit:
    """Most messages a second of the topics that match ``glob``, all topics together."""

    glob: str
    rate_hz: float

    def __str__(self) -> str:
        """``glob=rateHz``."""
        return f"{self.glob}={self.rate_hz:g}Hz"


@dataclass(frozen=True, slots=True)
class Credentials:
    """A certificate, its private key, and the CAs of the other side, all as PEM."""

    certificate: bytes
    key: bytes = field(repr=False)
    ca: bytes


class SettingError(ValueError):
    """A setting has an unusable value. ``option`` is the name on the command line."""

    def __init__(self, option: str, problem: str) -> None:
        super().__init__(f"{option}: {problem}")
        self.option = option


def time(least: float) -> Number:
    """A kind of value: a time of ``least`` seconds to a day."""
    return Number("S", least, DAY_S, seconds=True)


def read_range(text: str) -> PortRange:
    """Parse a range of ports, ``first-last``. Raises ValueError."""
    match = _RANGE.fullmatch(text)
    if match is None:
        raise ValueError(f"{text[:_LONGEST_QUOTE]!r} is not a range such as 11000-11099")
    ports = PortRange(int(match[1]), int(match[2]))
    if not 1 <= ports.first <= ports.last <= 65535:
        message = f"{text!r} must rise and stay between 1 and 65535, such as 11000-11099"
        raise ValueError(message)
    return ports


def read_host(text: str) -> str:
    """Parse a host name or address, and return the host without brackets. Raises ValueError."""
    bare = text.strip("[]")
    if parse_host_port(f"[{bare}]:1" if ":" in bare else f"{bare}:1") != HostPort(bare, 1):
        raise ValueError(
            f"{text[:_LONGEST_QUOTE]!r} is neither a host name nor an address such as 192.0.2.7"
        )
    return bare


def read_address(text: str) -> str | None:
    """Parse an IP address, and return the plain form; None for an empty text. Raises ValueError."""
    address = addresses.parse_address(text)
    if text and address is None:
        raise ValueError(f"{text[:_LONGEST_QUOTE]!r} is not an IP address such as 192.0.2.7")
    return address


def read_bind_address(text: str) -> str:
    """Parse an IP address to listen on; 0.0.0.0 and :: are valid. Raises ValueError."""
    try:
        return str(ip_address(text))
    except ValueError:
        message = f"{text[:_LONGEST_QUOTE]!r} is not an IP address of this host, such as 0.0.0.0"
        raise ValueError(message) from None


def read_host_port(text: str, example: str = "127.0.0.1:11312") -> HostPort:
    """Parse ``host:port`` or ``[v6]:port``. Raises ValueError, with the example."""
    target = parse_host_port(text)
    if target is None:
        raise ValueError(f"{text[:_LONGEST_QUOTE]!r} is not of the form {example}")
    return target


def read_peer(text: str) -> HostPort:
    """Parse a peer of ROS 2: ``host:port``, or a host, which gets port 0. Raises ValueError."""
    try:
        return HostPort(read_host(text), 0)
    except ValueError:
        return read_host_port(text, "HOST or HOST:PORT, such as robot or 192.0.2.7:11400")


def read_zenoh_peer(text: str) -> HostPort:
    """Parse a zenoh router: ``host:port``, or a host, which gets port 7447. Raises ValueError."""
    try:
        return HostPort(read_host(text), ZENOH_PORT)
    except ValueError:
        return read_host_port(text, "HOST or HOST:PORT, such as robot or 192.0.2.7:7447")


def read_site_link(text: str) -> SiteLink:
    """Parse ``tls/host``, ``tls/host:port`` or the same with quic. Raises ValueError."""
    protocol, _, peer = text.partition("/")
    try:
        if protocol in LINK_PROTOCOLS:
            return SiteLink(protocol, read_zenoh_peer(peer))
    except ValueError:
        pass  # the message below has an example for links
    example = "tls/HOST or tls/HOST:PORT, such as tls/cloud.example:7447"
    raise ValueError(f"{text[:_LONGEST_QUOTE]!r} is not of the form {example}")


def read_link_port(text: str) -> LinkPort:
    """Parse ``tls/port`` or ``quic/port``. Raises ValueError."""
    protocol, _, port = text.partition("/")
    is_number = port.isascii() and port.isdigit() and len(port) <= 5
    if protocol not in LINK_PROTOCOLS or not is_number or not 1 <= int(port) <= 65535:
        example = "tls/PORT or quic/PORT, such as tls/7447"
        raise ValueError(f"{text[:_LONGEST_QUOTE]!r} is not of the form {example}")
    return LinkPort(protocol, int(port))


def read_topic_limit(text: str) -> TopicLimit:
    """Parse ``glob=rate`` or ``glob=rateHz``. Raises ValueError."""
    glob, _, rate = text.rpartition("=")
    try:
        rate_hz = float(rate.removesuffix("Hz"))
    except ValueError:
        rate_hz = 0.0
    if not LEAST_RATE_HZ <= rate_hz <= MOST_RATE_HZ or glob[:1] not in ("/", "*"):
        example = "TOPIC=RATEHz, such as /camera/*=2Hz"
        bounds = f"with a rate from {LEAST_RATE_HZ:g} to {MOST_RATE_HZ:g}"
        raise ValueError(f"{text[:_LONGEST_QUOTE]!r} is not of the form {example}, {bounds}")
    if len(glob) > LONGEST_GLOB:
        raise ValueError(f"a topic must have at most {LONGEST_GLOB} characters")
    return TopicLimit(glob, rate_hz)


def read_network(text: str) -> Network:
    """Parse a network in CIDR notation. Raises ValueError."""
    try:
        return ip_network(text)
    except ValueError as error:
        message = f"{text[:_LONGEST_QUOTE]!r} is not a network such as 172.18.0.0/16: {error}"
        raise ValueError(message) from None


def read_master_uri(text: str) -> str:
    """Check the URI of a ROS master, and return the URI. Raises ValueError."""
    if not text.startswith("http://") or addresses.parse_authority(text) is None:
        raise ValueError(f"{text[:_LONGEST_QUOTE]!r} is not of the form http://host:11311")
    return text


def read_token(text: str) -> str | None:
    """Check a token for an HTTP header: printable ASCII without spaces; None for an empty text.

    Raises ValueError, which does not repeat the token.
    """
    if text and not _TOKEN.fullmatch(text):
        raise ValueError(
            "must be 8 to 200 letters, digits or signs without spaces, for example the output of "
            "openssl rand -hex 16"
        )
    return text or None


def read_token_hash(text: str) -> str | None:
    """Parse a SHA-256 in hex digits, in lower case; None for an empty text. Raises ValueError."""
    digits = text.strip().lower()
    if digits and not _HASH.fullmatch(digits):
        raise ValueError(
            'must be the 64 hex digits of a SHA-256; printf %s "$TOKEN" | sha256sum prints them'
        )
    return digits or None


def read_hub_certificate(text: str) -> Credentials | None:
    """Parse a hub's private key, certificate and CA; None for an empty text.

    Raises ValueError, which does not repeat the text.
    """
    if not text.strip():
        return None
    found = [*_PEM.finditer(text[:_LONGEST_PEM])]
    kinds = [block[1].rpartition("PRIVATE ")[2] for block in found]
    if kinds != ["KEY", "CERTIFICATE", "CERTIFICATE"]:
        raise ValueError(
            "must be three blocks of PEM: the private key, the certificate of this key, and the "
            "CA that has signed the certificate"
        )
    key, certificate, ca = (block[0].encode() for block in found)
    return Credentials(certificate, key, ca)


def read_policy_layers(text: str) -> tuple[PolicyLayer, ...]:
    """Parse the layers of a policy from JSON; empty for an empty text. Raises ValueError."""
    try:
        return read_layers(json.loads(text)) if text.strip() else ()
    except RecursionError:
        raise ValueError("the JSON is nested too deeply") from None


def hash_token(token: str) -> str:
    """The SHA-256 of a token in 64 hex digits, for ``--admin-token-hash``."""
    return hashlib.sha256(token.encode()).hexdigest()


def parse_range(option: str, text: str) -> PortRange:
    """Parse a range as `read_range` does. Raises SettingError, which names ``option``."""
    return _named(option, read_range, text)


def parse_host(option: str, text: str) -> str:
    """Parse a host as `read_host` does. Raises SettingError, which names ``option``."""
    return _named(option, read_host, text)


def _named(option: str, read: Callable[[str], _Value], text: str) -> _Value:
    try:
        return read(text)
    except ValueError as error:
        raise SettingError(option, str(error)) from None


def host_port(example: HostPort) -> Text:
    """A kind of value: ``host:port``, with ``example`` for messages."""
    return Text("ADDRESS:PORT", lambda text: read_host_port(text, str(example)))


PORT = Number("PORT", 1, 65535)
MEBIBYTES = Number("MiB", 1, 65536)
CONNECTIONS = Number("N", 16, 1_000_000)
DOMAIN = Number("ID", 0, LAST_DOMAIN)
PORT_RANGE = Text("A-B", read_range)
HOST = Text("HOST", read_host)
ADDRESS = Text("ADDRESS", read_address)
BIND_ADDRESS = Text("ADDRESS", read_bind_address)
HOST_PORT = Text("ADDRESS:PORT", read_host_port)
PEER = Text("HOST[:PORT]", read_peer)
ZENOH_PEER = Text("HOST[:PORT]", read_zenoh_peer)
SITE_LINK = Text("tls/HOST[:PORT]", read_site_link)
LINK_PORT = Text("tls/PORT", read_link_port)
TOPIC_LIMIT = Text("TOPIC=RATE", read_topic_limit)
NETWORK = Text("CIDR", read_network)
MASTER_URI = Text("URI", read_master_uri)
TOKEN = Text("TOKEN", read_token)
TOKEN_HASH = Text("HASH", read_token_hash)
POLICY_RULES = Text("RULES", parse_rules, separable=False)
POLICY_LAYERS = Text("JSON", read_policy_layers)
FILE = Text("FILE", str)
HUB_CERTIFICATE = Text("PEM", read_hub_certificate)
