"""The admission webhook's certificate, made here.

The CA signs one certificate, and the operator then drops the key of the CA: no second certificate
can be signed.
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

LIFE = timedelta(days=90)
RENEW_AFTER = 2 / 3
"""The part of its life after which a certificate is made anew."""
_BACKDATED = timedelta(hours=1)
"""So that an API server whose clock is slow takes it as well."""
CERTIFICATE = "tls.crt"
KEY = "tls.key"
CA = "ca.crt"
"""Keys of the Secret; ``ca.crt`` also has the CAs before, as long as they are valid."""


class InvalidCertificate(Exception):
    """What was found is no certificate with its key; the message says why."""


class KeyPair(msgspec.Struct, frozen=True):
    """A certificate with its key, and the CAs by which it is trusted, all as PEM.

    ``ca`` is empty if another program manages the CA.
    """

    certificate: bytes
    key: bytes
    ca: bytes = b""

    @property
    def expires(self) -> datetime:
        """When it is not valid any more."""
        return self._read().not_valid_after_utc

    def due(self, now: datetime) -> bool:
        """Whether it is time for another one."""
        certificate = self._read()
        life = certificate.not_valid_after_utc - certificate.not_valid_before_utc
        return now >= certificate.not_valid_before_utc + life * RENEW_AFTER

    def names(self) -> set[str]:
        """The DNS names that it is for."""
        try:
            names = self._read().extensions.get_extension_for_class(x509.SubjectAlternativeName)
        except x509.ExtensionNotFound:
            return set()
        return set(names.value.get_values_for_type(x509.DNSName))

    def _read(self) -> x509.Certificate:
        return x509.load_pem_x509_certificate(self.certificate)

    def secret(self) -> dict[str, str]:
        """The ``data`` of a Secret that holds it."""
        entries = {CERTIFICATE: self.certificate, KEY: self.key, CA: self.ca}
        return {name: base64.b64encode(text).decode() for name, text in entries.items()}


def service_names(namespace: str, name: str) -> list[str]:
    """The names under which an API server may call a Service."""
    bare = f"{name}.{namespace}"
    return [f"{bare}.svc", bare, f"{bare}.svc.cluster.local"]


def make(names: Iterable[str], now: datetime, before: bytes = b"") -> KeyPair:
    """A new certificate for DNS names, with a new CA.

    ``before`` are the former CAs: those that are valid stay trusted for the time in which the
    former certificate is still served.
    """
    authority_key, key = (ec.generate_private_key(ec.SECP256R1()) for _ in range(2))
    # A name of its own: of two CAs that are called the same, some clients try only the first.
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
    """A pair from the ``data`` of a Secret. Raises InvalidCertificate."""
    names = (CERTIFICATE, KEY, CA)
    try:
        decoded = [base64.b64decode(data[name], validate=True) for name in names]
    except KeyError as error:
        raise InvalidCertificate(f"no entry {error.args[0]}") from None
    except ValueError:
        raise InvalidCertificate("not valid base64") from None
    return checked(KeyPair(*decoded))


def checked(pair: KeyPair) -> KeyPair:
    """The same pair, if it is one that can be served. Raises InvalidCertificate."""
    try:
        load(ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), pair)
        x509.load_pem_x509_certificate(pair.certificate)
        x509.load_pem_x509_certificates(pair.ca) if pair.ca else None
    except (ssl.SSLError, ValueError) as error:
        raise InvalidCertificate(f"certificate and key can't be used: {error}") from None
    return pair


def load(context: ssl.SSLContext, pair: KeyPair) -> None:
    """Let a context serve a pair from its next connection on. Raises ssl.SSLError.

    Python's ssl reads keys from files alone; this one is only in memory.
    """
    file = os.memfd_create("rosproxy-webhook")
    try:
        os.write(file, pair.certificate.rstrip() + b"\n" + pair.key)
        context.load_cert_chain(f"/proc/self/fd/{file}")
    finally:
        os.close(file)


def _still_valid(authorities: bytes, now: datetime) -> bytes:
    """The certificates among these that are still valid; empty if they can't be read."""
    try:
        certificates = x509.load_pem_x509_certificates(authorities)
    except ValueError:
        return b""
    return b"".join(_pem(c) for c in certificates if c.not_valid_after_utc > now)


def now() -> datetime:
    """The time of day, in whole seconds as certificates have it."""
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
    """A certificate to be signed; one that ``signs`` is a CA's."""
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
        .not_valid_before(now - _BACKDATED)
        .not_valid_after(now + LIFE)
        .add_extension(constraints, critical=True)
        .add_extension(usage, critical=True)
    )


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)
