"""The certificates with which the hubs of a RosProxy for rmw_zenoh prove themselves to each other.

All hubs of a RosProxy have the same key and certificate, from a CA of their own. Both keys follow
from the key of the proxies' tokens. So an operator that starts again computes the same text, and
recreates no proxy: a signature of Ed25519 is always the same (RFC 8032). The certificate has no end
of its validity. A new key of the tokens replaces the certificate, with all proxies.
"""

import hashlib
import hmac
from collections.abc import Iterable
from datetime import UTC, datetime
from functools import lru_cache

from cryptography import x509
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from rosproxy_operator.kubernetes.resources.model import Name, RosProxy
from rosproxy_operator.kubernetes.resources.names import hub_domain

_BEGIN = datetime(2020, 1, 1, tzinfo=UTC)
_NO_END = datetime(9999, 12, 31, 23, 59, 59, tzinfo=UTC)
"""The time that stands for no end of the validity (RFC 5280, 4.1.2.5)."""
_CA = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "rosproxy hubs CA")])
_BOTH_SIDES = (ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH)
_HUB = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "rosproxy hub")])


def hub_certificates(rosproxies: Iterable[RosProxy], key: bytes) -> dict[Name, str]:
    """Return the text for ``ROSPROXY_ZENOH_HUB_CERTIFICATE`` of each RosProxy for rmw_zenoh.

    ``key`` is the key of the proxies' tokens; without a key there are no certificates.
    """
    return {r.id: hub_certificate(key, r.id) for r in rosproxies if r.spec.zenoh and key}


@lru_cache(maxsize=8192)
def hub_certificate(key: bytes, rosproxy: Name) -> str:
    """Return private key, certificate and CA of a RosProxy's hubs, as PEM."""
    authority_key = _private_key(key, f"hubs' CA of {rosproxy}")
    hub_key = _private_key(key, f"hubs of {rosproxy}")
    hosts = [x509.DNSName(f"*.{hub_domain(rosproxy)}")]
    authority = _certificate(_CA, authority_key, 1, signs=True).sign(authority_key, None)
    certificate = (
        _certificate(_HUB, hub_key, 2, signs=False)
        .add_extension(x509.SubjectAlternativeName(hosts), critical=False)
        .add_extension(x509.ExtendedKeyUsage(_BOTH_SIDES), critical=False)
        .sign(authority_key, None)
    )
    pem = serialization.Encoding.PEM
    private = hub_key.private_bytes(
        pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    return b"".join((private, certificate.public_bytes(pem), authority.public_bytes(pem))).decode()


def _private_key(key: bytes, purpose: str) -> Ed25519PrivateKey:
    """The private key for a purpose: HMAC-SHA256 (RFC 2104) of the purpose.

    ``purpose`` differs from the text of each token (`names.token_of`).
    """
    return Ed25519PrivateKey.from_private_bytes(
        hmac.new(key, purpose.encode(), hashlib.sha256).digest()
    )


def _certificate(
    subject: x509.Name, key: Ed25519PrivateKey, serial: int, signs: bool
) -> x509.CertificateBuilder:
    """A certificate without a signature; with ``signs`` the certificate of the CA."""
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(_CA)
        .public_key(key.public_key())
        .serial_number(serial)
        .not_valid_before(_BEGIN)
        .not_valid_after(_NO_END)
        .add_extension(x509.BasicConstraints(signs, 0 if signs else None), critical=True)
    )
