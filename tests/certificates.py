"""Certificates for tests: a CA, and what it signs, in files."""

from __future__ import annotations

import os
import shutil
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

DAY = timedelta(days=1)
CERTIFICATE = "tls.crt"
KEY = "tls.key"
CA = "ca.crt"


class Authority:
    """A CA. Each certificate is written with its key and the CA into a folder."""

    def __init__(self, name: str = "test CA", days: float = 3650.0) -> None:
        self._key = ec.generate_private_key(ec.SECP256R1())
        self._name = _name(name)
        builder = _builder(self._name, self._name, self._key, -DAY, days * DAY)
        builder = builder.add_extension(x509.BasicConstraints(True, None), critical=True)
        self._certificate = builder.sign(self._key, hashes.SHA256())

    @property
    def pem(self) -> bytes:
        """The certificate of the CA."""
        return self._certificate.public_bytes(Encoding.PEM)

    def write(
        self,
        folder: Path,
        *names: str,
        begins: timedelta = -DAY,
        ends: timedelta = 90 * DAY,
        usage: x509.ObjectIdentifier | None = None,
        curve: ec.EllipticCurve | None = None,
        own: bool = False,
    ) -> Path:
        """Sign a certificate for host names and addresses. Return the folder.

        With ``own``, write the certificate of the CA in place of a signed certificate.
        """
        key = ec.generate_private_key(curve or ec.SECP256R1())
        builder = _builder(_name(folder.name), self._name, key, begins, ends)
        if names:
            alternatives = x509.SubjectAlternativeName([_alternative(name) for name in names])
            builder = builder.add_extension(alternatives, critical=False)
        if usage:
            builder = builder.add_extension(x509.ExtendedKeyUsage([usage]), critical=False)
        folder.mkdir(parents=True, exist_ok=True)
        pem = builder.sign(self._key, hashes.SHA256()).public_bytes(Encoding.PEM)
        key = self._key if own else key
        (folder / CERTIFICATE).write_bytes(self.pem if own else pem)
        (folder / KEY).write_bytes(
            key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
        )
        (folder / CA).write_bytes(self.pem)
        return folder


CLIENTS = ExtendedKeyUsageOID.CLIENT_AUTH
SERVERS = ExtendedKeyUsageOID.SERVER_AUTH


def options(folder: Path) -> dict[str, str]:
    """The options of links between sites for the files in a folder."""
    return {
        "zenoh_certificate": str(folder / CERTIFICATE),
        "zenoh_key": str(folder / KEY),
        "zenoh_ca": str(folder / CA),
    }


def mount(volume: Path, content: Path) -> None:
    """Show the files of a folder in a volume, or replace those that it shows.

    As the kubelet mounts a Secret: each file is a symlink through ``..data``, a symlink that the
    kubelet replaces at once.
    """
    volume.mkdir(exist_ok=True)
    kept = volume / f"..{content.name}"
    shutil.copytree(content, kept)
    (volume / "..new").symlink_to(kept.name)
    os.replace(volume / "..new", volume / "..data")
    for name in (CERTIFICATE, KEY, CA):
        if not (volume / name).is_symlink():
            (volume / name).symlink_to(Path("..data") / name)


def _name(text: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


def _alternative(name: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ip_address(name))
    except ValueError:
        return x509.DNSName(name)


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePrivateKey,
    begins: timedelta,
    ends: timedelta,
) -> x509.CertificateBuilder:
    now = datetime.now(UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now + begins)
        .not_valid_after(now + ends)
    )
