"""Reads and checks the files of links to other sites: certificate, key and CAs.

OpenSSL checks the files, because zenoh would reject a bad file only when a link comes up. To read
the lifetime of the certificate, both ends of a connection in memory use the certificate: Python's
ssl describes only certificates that a connection has shown.
"""

import contextlib
import os
import ssl
from collections.abc import Mapping
from typing import Any, NamedTuple

from rosproxy.access.policy_file import file_signature
from rosproxy.settings import Settings
from rosproxy.zenoh.link_router import Credentials

LONGEST_FILE_BYTES = 1024 * 1024
"""Largest file that the proxy reads, in bytes."""
CERTIFICATE = "--zenoh-certificate"
KEY = "--zenoh-key"
CA = "--zenoh-ca"
_NO_CHECK_TIME = 0x200000
"""X509_V_FLAG_NO_CHECK_TIME (openssl/x509_vfy.h): the certificate may have expired."""
_MOST_ROUNDS = 10
"""Rounds of messages in a handshake; TLS 1.3 needs two."""
_PEM_CERTIFICATE = b"-----BEGIN CERTIFICATE-----"


class UnusableFile(ValueError):
    """A file can't be used. The text says why. ``option`` names the file."""

    def __init__(self, option: str, path: str, text: str) -> None:
        super().__init__(f"{path} {text}")
        self.option = option
        self.path = path
        self.text = text


class Lifetime(NamedTuple):
    """The time in which a certificate is valid, in seconds of Unix time."""

    begin: float
    end: float


class LinkFiles(NamedTuple):
    """The contents of the files, and the lifetimes of the certificates by path.

    ``client`` makes connections as zenoh makes them, to find out why a link is down.
    """

    credentials: Credentials
    lifetimes: Mapping[str, Lifetime]
    client: ssl.SSLContext


def paths_of(settings: Settings) -> dict[str, str]:
    """The path of each file, by option."""
    return {
        CERTIFICATE: settings.zenoh_certificate,
        KEY: settings.zenoh_key,
        CA: settings.zenoh_ca,
    }


def signatures(paths: Mapping[str, str]) -> list[object]:
    """Values that differ if a file has changed. Raises OSError."""
    return [file_signature(os.stat(path)) for path in paths.values()]


def read_link_files(settings: Settings) -> LinkFiles:
    """Read and check the files. Raises UnusableFile."""
    paths = paths_of(settings)
    contents = {option: _read(option, path) for option, path in paths.items()}
    credentials = Credentials(contents[CERTIFICATE], contents[KEY], contents[CA])
    client = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    cas = _certificates(CA, paths, contents[CA], client)
    if not cas:
        raise UnusableFile(CA, paths[CA], "has no certificate of a CA (CA:TRUE)")
    chain = _chain(settings, credentials, paths)
    _load_key(client, credentials, paths)
    lifetimes = {
        paths[CERTIFICATE]: Lifetime(max(c.begin for c in chain), min(c.end for c in chain)),
        paths[CA]: Lifetime(min(c.begin for c in cas), max(c.end for c in cas)),
    }
    return LinkFiles(credentials, lifetimes, client)


def _read(option: str, path: str) -> bytes:
    try:
        with open(path, "rb") as file:
            content = file.read(LONGEST_FILE_BYTES + 1)
    except PermissionError:
        user = f"user {os.getuid()}, as which the proxy runs"
        raise UnusableFile(option, path, f"can't be read: let {user}, read it") from None
    except OSError as error:
        raise UnusableFile(option, path, f"can't be read: {error.strerror}") from None
    if len(content) > LONGEST_FILE_BYTES:
        raise UnusableFile(option, path, f"is longer than {LONGEST_FILE_BYTES} bytes")
    return content


def _certificates(
    option: str, paths: Mapping[str, str], content: bytes, context: ssl.SSLContext
) -> list[Lifetime]:
    """Let a context trust certificates. Return the lifetimes of the CAs among them.

    Raises UnusableFile.
    """
    text = "has no certificate as PEM"
    try:
        if _PEM_CERTIFICATE not in content:
            raise UnusableFile(option, paths[option], text)
        context.load_verify_locations(cadata=content.decode("ascii", "ignore"))
    except ssl.SSLError as error:
        raise UnusableFile(option, paths[option], f"{text}: {error.reason}") from None
    return [_lifetime(certificate) for certificate in context.get_ca_certs()]


def _lifetime(certificate: Mapping[str, Any]) -> Lifetime:
    begin, end = (ssl.cert_time_to_seconds(certificate[k]) for k in ("notBefore", "notAfter"))
    return Lifetime(begin, end)


def _load_key(context: ssl.SSLContext, credentials: Credentials, paths: Mapping[str, str]) -> None:
    """Let a context use certificate and key. Raises UnusableFile.

    Python's ssl reads keys only from files. A memfd has the contents that zenoh gets.
    """
    if b"ENCRYPTED" in credentials.key:
        text = "has a passphrase. Write the key without: openssl pkey -in FILE -out FILE"
        raise UnusableFile(KEY, paths[KEY], text)
    file = os.memfd_create("rosproxy-link")
    try:
        os.write(file, credentials.certificate.rstrip() + b"\n" + credentials.key)
        # Without a password, OpenSSL would ask for one at the terminal.
        context.load_cert_chain(f"/proc/self/fd/{file}", password="")
    except ssl.SSLError as error:
        if error.reason == "KEY_VALUES_MISMATCH":
            text = f"does not belong to the certificate in {paths[CERTIFICATE]}"
        else:
            text = f"has no key as PEM that can be used: {error.reason or 'no PEM'}"
        raise UnusableFile(KEY, paths[KEY], text) from None
    finally:
        os.close(file)


def _chain(
    settings: Settings, credentials: Credentials, paths: Mapping[str, str]
) -> list[Lifetime]:
    """The lifetimes of the own certificate and of the CAs in its file. Raises UnusableFile."""
    path = paths[CERTIFICATE]
    roles = {"clients": bool(settings.zenoh_link), "servers": bool(settings.zenoh_link_listen)}
    for role in (role for role, is_used in roles.items() if is_used):
        server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        client = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        client.check_hostname = False
        client.verify_mode = ssl.CERT_NONE
        checking = client if role == "servers" else server
        checking.verify_mode = ssl.CERT_REQUIRED
        chain = _certificates(CERTIFICATE, paths, credentials.certificate, checking)
        checking.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN | _NO_CHECK_TIME
        for context in (client, server):
            _load_key(context, credentials, paths)
        try:
            shown = _shown_certificate(client, server, checking)
        except ssl.SSLError as error:
            reason = getattr(error, "verify_message", None) or error.reason
            text = f"has no certificate for {role} of TLS: {reason}"
            raise UnusableFile(CERTIFICATE, path, text) from None
        if shown in checking.get_ca_certs():
            text = "begins with the certificate of a CA. Sign a certificate with this CA"
            raise UnusableFile(CERTIFICATE, path, text)
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
