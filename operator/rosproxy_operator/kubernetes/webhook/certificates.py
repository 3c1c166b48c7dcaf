"""Creates and checks the certificate of the admission webhook.

The operator creates a CA for each certificate, signs the certificate, and drops the key of the CA.
So no further certificate of this CA can exist.
"""

import base64
import os
import secrets
import ssl
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime, timedelta

import msgspec
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

LIFETIME = timedelta(days=90)
"""Lifetime of a certificate and of the CA."""
RENEW_AFTER_SHARE = 2 / 3
"""Share of the lifetime after which the operator replaces a certificate."""
_CLOCK_TOLERANCE = timedelta(hours=1)
"""How far before now the validity starts, because the clock of an API server may be slow."""
CERTIFICATE = "tls.crt"
KEY = "tls.key"
CA = "ca.crt"
"""Keys of the Secret. ``ca.crt`` also has former CAs that are still valid."""


class InvalidCertificate(Exception):
    """The data is not a certificate with a matching key. The message gives the reason."""


class KeyPair(msgspec.Struct, frozen=True):
    """A certificate, the key of the certificate, and the trusted CAs, all as PEM.

    ``ca`` is empty if another program manages the CA.
    """

    certificate: bytes
    key: bytes
    ca: bytes = b""

    @property
    def expires(self) -> datetime:
        """The end of the certificate's lifetime."""
        return self._read().not_valid_after_utc

    def is_due(self, now: datetime) -> bool:
        """Whether the operator has to replace the certificate now (`RENEW_AFTER_SHARE`)."""
        certificate = self._read()
        life = certificate.not_valid_after_utc - certificate.not_valid_before_utc
        return now >= certificate.not_valid_before_utc + life * RENEW_AFTER_SHARE

    def names(self) -> set[str]:
        """The DNS names of the certificate; empty without the extension subjectAltName."""
        try:
            names = self._read().extensions.get_extension_for_class(x509.SubjectAlternativeName)
        except x509.ExtensionNotFound:
            return set()
        return set(names.value.get_values_for_type(x509.DNSName))

    def _read(self) -> x509.Certificate:
        return x509.load_pem_x509_certificate(self.certificate)

    def secret(self) -> dict[str, str]:
        """The ``data`` of a Secret for the pair, in base64."""
        entries = {CERTIFICATE: self.certificate, KEY: self.key, CA: self.ca}
        return {name: base64.b64encode(text).decode() for name, text in entries.items()}


def service_names(namespace: str, name: str) -> list[str]:
    """The DNS names by which an API server may call a Service."""
    bare = f"{name}.{namespace}"
    return [f"{bare}.svc", bare, f"{bare}.svc.cluster.local"]


def make(names: Iterable[str], now: datetime, before: bytes = b"") -> KeyPair:
    """Create a certificate for DNS names, and a new CA.

    ``before`` are the former CAs as PEM. Valid former CAs stay trusted, because operators still
    serve the former certificate for a while.
    """
    authority_key, key = (ec.generate_private_key(ec.SECP256R1()) for _ in range(2))
    # A random name: of two CAs with the same name, some clients try only the first.
    authority = _name(f"rosproxy webhook {secrets.token_hex(8)}")
    ca = _builder(authority, authority, authority_key, now, signs=True)
    certificate = (
        _builder(_name("rosproxy webhook"), authority, key, now, signs=False)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        .add_extension(
            x509.SubjectAlternativeName([x509.DNSName(name) for name in names]), critical=False
        )
    )
    private = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    signed, trusted = (b.sign(authority_key, hashes.SHA256()) for b in (certificate, ca))
    return KeyPair(_pem(signed), private, _pem(trusted) + _still_valid(before, now))


def read(data: Mapping[str, str]) -> KeyPair:
    """Read a pair from the ``data`` of a Secret. Raises InvalidCertificate."""
    names = (CERTIFICATE, KEY, CA)
    try:
        decoded = [base64.b64decode(data[name], validate=True) for name in names]
    except KeyError as error:
        raise InvalidCertificate(f"no entry {error.args[0]}") from None
    except ValueError:
        raise InvalidCertificate("not valid base64") from None
    return checked(KeyPair(*decoded))


def checked(pair: KeyPair) -> KeyPair:
    """Return the pair unchanged if a server can serve the pair. Raises InvalidCertificate."""
    try:
        load(ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), pair)
        x509.load_pem_x509_certificate(pair.certificate)
        x509.load_pem_x509_certificates(pair.ca) if pair.ca else None
    except (ssl.SSLError, ValueError) as error:
        raise InvalidCertificate(f"certificate and key can't be used: {error}") from None
    return pair


def load(context: ssl.SSLContext, pair: KeyPair) -> None:
    """Let a context serve a pair from the next connection on. Raises ssl.SSLError.

    Python's ssl reads keys only from files. A memfd keeps the key off the disk.
    """
    file = os.memfd_create("rosproxy-webhook")
    try:
        os.write(file, pair.certificate.rstrip() + b"\n" + pair.key)
        context.load_cert_chain(f"/proc/self/fd/{file}")
    finally:
        os.close(file)


def _still_valid(authorities: bytes, now: datetime) -> bytes:
    """The certificates that are still valid, as PEM; empty if the PEM text is unreadable."""
    try:
        certificates = x509.load_pem_x509_certificates(authorities)
    except ValueError:
        return b""
    return b"".join(_pem(c) for c in certificates if c.not_valid_after_utc > now)


def now() -> datetime:
    """The time in UTC, in whole seconds as in certificates."""
    return datetime.now(UTC).replace(microsecond=0)


def _name(text: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePrivateKey,
    now: datetime,
    signs: bool,
) -> x509.CertificateBuilder:
    """An unsigned certificate; with ``signs`` the certificate of a CA."""
    usage = x509.KeyUsage(
        digital_signature=not signs,
        key_cert_sign=signs,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        crl_sign=False,
        encipher_only=False,
        decipher_only=False,
    )
    constraints = x509.BasicConstraints(ca=signs, path_length=0 if signs else None)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _CLOCK_TOLERANCE)
        .not_valid_after(now + LIFETIME)
        .add_extension(constraints, critical=True)
        .add_extension(usage, critical=True)
    )


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)
