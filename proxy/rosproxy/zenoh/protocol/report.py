"""The reports of the router process to the proxy: a line of JSON for each look at the routers.

A router describes itself in zenoh's admin space at ``@/ZID/router``. A report has the sessions of
this description. The router process bounds a report, and the proxy bounds the line.
"""

from collections.abc import Iterator
from typing import NamedTuple

import msgspec

from rosproxy.shared.addresses import HostPort, parse_authority, plain_address

LONGEST_REPORT = 16 * 1024 * 1024
"""Bytes of a line. A report with the most sessions and the most tokens has some 10 MB."""
MOST_SESSIONS = 1000
"""Most sessions of a router, if the limit of open files allows as many."""


class SessionConnection(msgspec.Struct, frozen=True):
    """A connection of a session, with both ends as ``tcp/address:port``. zenoh calls it a link."""

    src: str = ""
    dst: str = ""


class RouterSession(msgspec.Struct, frozen=True):
    """A session of a router: the zenoh ID and the mode of the other end."""

    peer: str = ""
    whatami: str = ""
    links: tuple[SessionConnection, ...] = ()


class RouterReport(msgspec.Struct, frozen=True):
    """A router: the zenoh ID, the sessions, and where the router listens, as ``tls/host:port``.

    ``most_sessions``: the number of sessions from which on the router refuses others; 0: unknown.
    """

    zid: str
    sessions: tuple[RouterSession, ...] = ()
    locators: tuple[str, ...] = ()
    most_sessions: int = 0

    @property
    def is_full(self) -> bool:
        """Whether the router refuses further sessions."""
        return 0 < self.most_sessions <= len(self.sessions)


class Report(msgspec.Struct, frozen=True):
    """A report: the routers in the order of their configurations, and the liveliness tokens.

    ``tokens`` is None if nothing has changed since the last report. ``tokens_left_out`` counts
    tokens above the bound. ``error``: why the routers do not run; empty if the routers run.
    ``revision``: the revision of the configurations with which the routers run. ``outside``: what
    routers outside, and their peers, say about their sessions with peers and with the hub.
    """

    routers: tuple[RouterReport, ...] = ()
    tokens: tuple[str, ...] | None = None
    tokens_left_out: int = 0
    error: str = ""
    revision: int = 0
    outside: tuple[RouterReport, ...] = ()


class Ends(NamedTuple):
    """The two ends of a session, as the router sees them."""

    local: HostPort
    remote: HostPort


def read_report(line: bytes) -> Report:
    """The report in a line. Raises ValueError."""
    try:
        return msgspec.json.decode(line, type=Report)
    except msgspec.MsgspecError as error:
        raise ValueError(f"a report that is not valid: {error}") from None


def ends_of(session: RouterSession) -> Ends | None:
    """The two ends of a session's first connection by TCP, TLS or QUIC; None if there is none."""
    return next(all_ends_of(session), None)


def all_ends_of(session: RouterSession) -> Iterator[Ends]:
    """The two ends of each connection by TCP, TLS or QUIC; two if both routers have dialed."""
    for link in session.links:
        local = _end(link.src)
        remote = _end(link.dst)
        if local and remote:
            yield Ends(local, remote)


def _end(locator: str) -> HostPort | None:
    """The address and port of a locator such as ``tcp/192.0.2.7:7447?prio=1-7``.

    None if the locator is not of TCP, TLS or QUIC, or has no address.
    """
    protocol, _, rest = locator.partition("/")
    address = rest.partition("?")[0].partition("#")[0]
    end = parse_authority(f"//{address}") if protocol in ("tcp", "tls", "quic") else None
    # A router that listens on [::] sees IPv4 as ::ffff:192.0.2.7.
    return HostPort(plain_address(end.host), end.port) if end else None
