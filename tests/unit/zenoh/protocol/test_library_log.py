"""Lines that zenoh 1.7.2 logs about connections by TLS and QUIC."""

import pytest

from rosproxy.zenoh.protocol.library_log import certificate_refusal, is_about_links

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
