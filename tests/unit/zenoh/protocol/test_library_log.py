"""Lines that zenoh 1.7.2 logs about the dialing of routers, and about certificates."""

import pytest

from rosproxy.zenoh.protocol.library_log import (
    certificate_refusal,
    is_about_dialing,
    is_about_links,
    note_dialing,
)

TLS = "2026-11-28T01:03:54.448079Z  WARN acc-0 ThreadId(04) zenoh_link_tls::unicast: {}. Hint: "
QUIC = (
    "2026-11-28T01:03:57.636185Z  WARN acc-0 ThreadId(04) zenoh_link_quic::unicast: QUIC acceptor "
    'failed: TransportError(Error {{ code: Code::crypto(30), frame: None, reason: "{}" }}) at x.rs'
)
COLOURED = (
    "\x1b[2m2026-11-28T00:31:54Z\x1b[0m \x1b[33m WARN\x1b[0m acc-0 ThreadId(04) "
    "\x1b[2mzenoh_link_tls::unicast\x1b[0m\x1b[2m:\x1b[0m {}."
)


@pytest.mark.parametrize("line", [TLS, QUIC, COLOURED])
@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("invalid peer certificate: UnknownIssuer", "is of a CA that this proxy does not trust"),
        ("invalid peer certificate: BadSignature", "is of a CA that this proxy does not trust"),
        ("invalid peer certificate: certificate expired: verification time 17", "has expired"),
        ("invalid peer certificate: certificate not valid yet: ver", "is not valid yet"),
        ("invalid peer certificate: CaUsedAsEndEntity", "is not valid for a TLS client"),
        ("peer sent no certificates", None),
        ("tls handshake eof", None),
    ],
)
def test_the_reason_of_a_refusal_is_read(line: str, text: str, reason: str | None) -> None:
    assert is_about_links(line.format(text))
    assert certificate_refusal(line.format(text)) == reason


def test_other_lines_are_not_about_links() -> None:
    assert not is_about_links("ERROR zenoh::api::admin: Unable to publish transport event")
    assert not is_about_links("thread panicked at zenoh_link_tls")


ORCHESTRATOR = (
    "\x1b[2m2026-11-29T14:41:35.549587Z\x1b[0m \x1b[34mDEBUG\x1b[0m net-0 ThreadId(03) "
    "\x1b[2mzenoh::net::runtime::orchestrator\x1b[0m\x1b[2m:\x1b[0m "
)


def test_it_is_noted_which_endpoint_is_dialed_again() -> None:
    connected: dict[str, float] = {}

    def note(text: str) -> dict[str, float]:
        assert is_about_dialing(ORCHESTRATOR + text)
        note_dialing(ORCHESTRATOR + text, connected, 7.0)
        return connected

    tries = "Try to connect: {}: global timeout: 18446744073709551615.999999999s, retry: Connection"
    assert note(tries.format("tcp/[::1]:7447")) == {}
    refused = "Unable to connect to configured peer tcp/[::1]:7447! Can not create a new TCP link"
    assert note(refused) == {}
    reached = "Successfully connected to configured peer tcp/[::1]:7447"
    assert note(reached) == {"tcp/[::1]:7447": 7.0}
    assert note(tries.format("tcp/robot:7447")) == {"tcp/[::1]:7447": 7.0}
    assert note(tries.format("tcp/[::1]:7447")) == {}


def test_errors_are_logged_as_other_lines() -> None:
    error = ORCHESTRATOR.replace("DEBUG", "ERROR") + "Unable to open listener tcp/[::]:7447: in use"
    assert not is_about_dialing(error)
