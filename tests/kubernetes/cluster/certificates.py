"""Identities in the cluster: an authority, a certificate for each program, and kubeconfigs."""

import base64
import datetime
import ipaddress
import json
from dataclasses import dataclass
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
)
from cryptography.x509.oid import NameOID

from tests.kubernetes.cluster.layout import (
    API_SERVER,
    API_SERVICE,
    GATEWAY,
    KUBECONFIG,
    NODES,
    PKI,
    STATE,
)

_YEAR = datetime.timedelta(days=365)
_API_NAMES = ("kubernetes", "kubernetes.default", "kubernetes.default.svc", "localhost",
              "127.0.0.1", API_SERVICE, GATEWAY)  # fmt: skip


@dataclass(frozen=True)
class LeaseHolder:
    """A holder of a key and a certificate, in the files ``NAME.key`` and ``NAME.crt``."""

    name: str
    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey

    def write(self) -> None:
        pem = self.certificate.public_bytes(Encoding.PEM)
        certificate_file(self.name).write_bytes(pem)
        _write_key(self.name, self.key)


def certificate_file(name: str) -> Path:
    return PKI / f"{name}.crt"


def key_file(name: str) -> Path:
    return PKI / f"{name}.key"


def make_certificates() -> None:
    """Make all keys, certificates and kubeconfigs, unless they exist."""
    if KUBECONFIG.exists():
        return
    PKI.mkdir(parents=True, exist_ok=True)
    PKI.chmod(0o700)
    authority = _authority()
    authority.write()
    _issue(authority, "apiserver", "kube-apiserver", names=_API_NAMES)
    for node in NODES:
        _issue(authority, node.name, f"system:node:{node.name}", "system:nodes", (node.address,))
        write_kubeconfig(node.kubeconfig, node.name)
    for name in ("kube-controller-manager", "kube-scheduler", "kube-proxy"):
        _issue(authority, name, f"system:{name}")
        write_kubeconfig(STATE / f"{name}.kubeconfig", name)
    _service_account_key()
    _issue(authority, "admin", "admin", "system:masters")
    write_kubeconfig(KUBECONFIG, "admin")


def write_kubeconfig(file: Path, holder: str) -> None:
    """Write the complete kubeconfig of a holder."""

    def data(path: Path) -> str:
        return base64.b64encode(path.read_bytes()).decode()

    cluster = {"server": API_SERVER, "certificate-authority-data": data(certificate_file("ca"))}
    user = {"client-certificate-data": data(certificate_file(holder)),
            "client-key-data": data(key_file(holder))}  # fmt: skip
    config = {
        "apiVersion": "v1",
        "kind": "Config",
        "clusters": [{"name": "rosproxy", "cluster": cluster}],
        "users": [{"name": holder, "user": user}],
        "contexts": [{"name": "rosproxy", "context": {"cluster": "rosproxy", "user": holder}}],
        "current-context": "rosproxy",
    }
    file.write_text(json.dumps(config, indent=1))
    file.chmod(0o600)


def _authority() -> LeaseHolder:
    key = _new_key()
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "rosproxy test cluster")])
    usage = x509.KeyUsage(
        digital_signature=True, key_cert_sign=True, crl_sign=True, content_commitment=False,
        key_encipherment=False, data_encipherment=False, key_agreement=False,
        encipher_only=False, decipher_only=False,
    )  # fmt: skip
    builder = (
        _builder(name, name, key)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage, critical=True)
    )
    return LeaseHolder("ca", builder.sign(key, hashes.SHA256()), key)


def _issue(
    authority: LeaseHolder, name: str, common_name: str, organization: str = "",
    names: tuple[str, ...] = (),
) -> None:  # fmt: skip
    key = _new_key()
    parts = [x509.NameAttribute(NameOID.COMMON_NAME, common_name)]
    if organization:
        parts.append(x509.NameAttribute(NameOID.ORGANIZATION_NAME, organization))
    builder = _builder(x509.Name(parts), authority.certificate.subject, key)
    if names:
        builder = builder.add_extension(
            x509.SubjectAlternativeName([_general_name(name) for name in names]), critical=False
        )
    LeaseHolder(name, builder.sign(authority.key, hashes.SHA256()), key).write()


def _general_name(name: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(name))
    except ValueError:
        return x509.DNSName(name)


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey
) -> x509.CertificateBuilder:
    now = datetime.datetime.now(datetime.UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(hours=1))
        .not_valid_after(now + _YEAR)
    )


def _service_account_key() -> None:
    """The key with which the controller manager signs what pods identify themselves with."""
    key = _new_key()
    _write_key("service-account", key)
    public = key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
    (PKI / "service-account.pub").write_bytes(public)


def _new_key() -> ec.EllipticCurvePrivateKey:
    return ec.generate_private_key(ec.SECP256R1())


def _write_key(name: str, key: ec.EllipticCurvePrivateKey) -> None:
    pem = key.private_bytes(Encoding.PEM, PrivateFormat.TraditionalOpenSSL, NoEncryption())
    key_file(name).write_bytes(pem)
