"""Lines that the zenoh library logs about the dialing of routers, and about certificates.

The certificates are those of links to other sites and to hubs. The library logs each connection
that it refuses, without the address of the other end. The texts are those of rustls
(rustls/src/error.rs).
"""

import re

LEVELS = "error,zenoh_link_tls=warn,zenoh_link_quic=warn,zenoh::net::runtime::orchestrator=debug"
"""What the library logs: the value of RUST_LOG."""
_ABOUT_LINKS = re.compile(r"WARN.*zenoh_link_(?:tls|quic)")
_ABOUT_DIALING = re.compile(r"(?:DEBUG|INFO|WARN).*zenoh::net::runtime::orchestrator")
_DIALS = re.compile(r"Try to connect: (\S+): global timeout")
_CONNECTED = re.compile(r"Successfully connected to configured peer (\S+)")
_REFUSALS = (
    (
        re.compile(r"invalid peer certificate: (?:UnknownIssuer|BadSignature)"),
        "is of a CA that this proxy does not trust",
    ),
    (re.compile(r"invalid peer certificate: certificate expired"), "has expired"),
    (re.compile(r"invalid peer certificate: certificate not valid yet"), "is not valid yet"),
    (re.compile(r"invalid peer certificate: "), "is not valid for a TLS client"),
)
"""Programs without a certificate, such as port scanners, are not reported."""


def is_about_links(line: str) -> bool:
    """Whether the library warns of a connection by TLS or QUIC."""
    return _ABOUT_LINKS.search(line) is not None


def certificate_refusal(line: str) -> str | None:
    """Why the library has refused the certificate of another proxy; None for other warnings."""
    return next((text for pattern, text in _REFUSALS if pattern.search(line)), None)


def is_about_dialing(line: str) -> bool:
    """Whether the library logs what it dials, and not an error."""
    return _ABOUT_DIALING.search(line) is not None


def note_dialing(line: str, connected: dict[str, float], now: float) -> None:
    """Note an endpoint to which the library has connected, or remove one that it dials again."""
    if dialed := _DIALS.search(line):
        connected.pop(dialed[1], None)
    elif reached := _CONNECTED.search(line):
        connected[reached[1]] = now
