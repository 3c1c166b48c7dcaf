"""Checks certificates: of links to other sites, and of hubs.

OpenSSL checks the certificates, because zenoh would reject a bad one only when a link comes up. To
read the lifetime of a certificate, both ends of a connection in memory use the certificate:
Python's ssl describes only certificates that a connection has shown.
"""

import contextlib
import os
import ssl
from collections.abc import Collection, Mapping
from typing import Any, Literal, NamedTuple

from rosproxy.shared.setting_kinds import Credentials

Part = Literal["certificate", "key", "CA"]
_NO_CHECK_TIME = 0x200000
"""X509_V_FLAG_NO_CHECK_TIME (openssl/x509_vfy.h): the certificate may have expired."""
_MOST_ROUNDS = 10
"""Rounds of messages in a handshake; TLS 1.3 needs two."""
_PEM_CERTIFICATE = b"-----BEGIN CERTIFICATE-----"
CLIENTS = "clients"
SERVERS = "servers"


class Unusable(ValueError):
    """A part of the credentials can't be used. The text says why."""

    def __init__(self, part: Part, text: str) -> None:
        super().__init__(f"the {part} {text}")
        self.part = part
        self.text = text


class Lifetime(NamedTuple):
    """The time in which a certificate is valid, in seconds of Unix time."""

    begin: float
    end: float


class Checked(NamedTuple):
    """What a check has found: the lifetimes of the certificate, with its chain, and of the CAs.

    ``client`` makes connections as zenoh makes them, to find out why a link is down.
    """

    certificate: Lifetime
    ca: Lifetime
    client: ssl.SSLContext


def check_credentials(credentials: Credentials, roles: Collection[str]) -> Checked:
    """Check credentials for roles: CLIENTS, SERVERS or both. Raises Unusable."""
    client = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    cas = _certificates("CA", credentials.ca, client)
    if not cas:
        raise Unusable("CA", "has no certificate of a CA (CA:TRUE)")
    chain = _chain(credentials, roles)
    _load_key(client, credentials)
    return Checked(
        Lifetime(max(c.begin for c in chain), min(c.end for c in chain)),
        Lifetime(min(c.begin for c in cas), max(c.end for c in cas)),
        client,
    )


def _certificates(part: Part, content: bytes, context: ssl.SSLContext) -> list[Lifetime]:
    """Let a context trust certificates. Return the lifetimes of the CAs among them.

    Raises Unusable.
    """
    text = "has no certificate as PEM"
    try:
        if _PEM_CERTIFICATE not in content:
            raise Unusable(part, text)
        context.load_verify_locations(cadata=content.decode("ascii", "ignore"))
    except ssl.SSLError as error:
        raise Unusable(part, f"{text}: {error.reason}") from None
    return [_lifetime(certificate) for certificate in context.get_ca_certs()]


def _lifetime(certificate: Mapping[str, Any]) -> Lifetime:
    begin, end = (ssl.cert_time_to_seconds(certificate[k]) for k in ("notBefore", "notAfter"))
    return Lifetime(begin, end)


def _load_key(context: ssl.SSLContext, credentials: Credentials) -> None:
    """Let a context use certificate and key. Raises Unusable.

    Python's ssl reads keys only from files. A memfd has the contents that zenoh gets.
    """
    if b"ENCRYPTED" in credentials.key:
        text = "has a passphrase. Write the key without: openssl pkey -in FILE -out FILE"
        raise Unusable("key", text)
    file = os.memfd_create("rosproxy-key")
    try:
        os.write(file, credentials.certificate.rstrip() + b"\n" + credentials.key)
        # Without a password, OpenSSL would ask for one at the terminal.
        context.load_cert_chain(f"/proc/self/fd/{file}", password="")
    except ssl.SSLError as error:
        if error.reason == "KEY_VALUES_MISMATCH":
            text = "does not belong to the certificate"
        else:
            text = f"has no key as PEM that can be used: {error.reason or 'no PEM'}"
        raise Unusable("key", text) from None
    finally:
        os.close(file)


def _chain(credentials: Credentials, roles: Collection[str]) -> list[Lifetime]:
    """The lifetimes of the own certificate and of the CAs with it. Raises Unusable."""
    for role in roles:
        server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        client = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        client.check_hostname = False
        client.verify_mode = ssl.CERT_NONE
        checking = client if role == SERVERS else server
        checking.verify_mode = ssl.CERT_REQUIRED
        chain = _certificates("certificate", credentials.certificate, checking)
        checking.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN | _NO_CHECK_TIME
        for context in (client, server):
            _load_key(context, credentials)
        try:
            shown = _shown_certificate(client, server, checking)
        except ssl.SSLError as error:
            reason = getattr(error, "verify_message", None) or error.reason
            text = f"has no certificate for {role} of TLS: {reason}"
            raise Unusable("certificate", text) from None
        if shown in checking.get_ca_certs():
            text = "begins with the certificate of a CA. Sign a certificate with this CA"
            raise Unusable("certificate", text)
    return [_lifetime(shown), *chain]


def _shown_certificate(
    client: ssl.SSLContext, server: ssl.SSLContext, checking: ssl.SSLContext
) -> dict[str, Any]:
    """The certificate that the ``checking`` end gets in a handshake. Raises ssl.SSLError."""
    to_server = ssl.MemoryBIO()
    to_client = ssl.MemoryBIO()
    at_server = server.wrap_bio(to_server, to_client, server_side=True)
    at_client = client.wrap_bio(to_client, to_server)
    for _ in range(_MOST_ROUNDS):
        for end in (at_client, at_server):
            with contextlib.suppress(ssl.SSLWantReadError):
                end.do_handshake()
    shown = (at_client if checking is client else at_server).getpeercert()
    return shown or {}
