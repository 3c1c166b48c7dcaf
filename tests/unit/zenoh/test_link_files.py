"""The files of links to other sites: what is read, and what can not be used."""

import os
import re
import ssl
import subprocess
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric import ec

from rosproxy.shared.settings import Settings
from rosproxy.zenoh import certificates as checks
from rosproxy.zenoh.link_files import UnusableFile, read_link_files
from tests import certificates
from tests.certificates import CA, CERTIFICATE, CLIENTS, DAY, KEY, SERVERS, Authority
from tests.run_options import parse_settings

ROLES: dict[str, dict[str, Any]] = {
    "clients": {"zenoh_link": ("tls/cloud.example",)},
    "servers": {"zenoh_link_listen": "tls/7447"},
}


def settings(folder: Path, role: str = "clients") -> Settings:
    given = {"ros": ("zenoh",), **ROLES[role], **certificates.options(folder)}
    return parse_settings(given)


def fault(folder: Path, role: str = "clients") -> str:
    with pytest.raises(UnusableFile) as caught:
        read_link_files(settings(folder, role))
    return f"{caught.value.option} {str(caught.value).replace(f'{folder}/', '')}"


@pytest.fixture(scope="module")
def authority() -> Authority:
    return Authority()


@pytest.fixture
def good(authority: Authority, tmp_path: Path) -> Path:
    return authority.write(tmp_path / "good", "cloud.example")


@pytest.mark.parametrize("role", ROLES)
def test_the_contents_and_the_lifetimes(good: Path, authority: Authority, role: str) -> None:
    files = read_link_files(settings(good, role))
    assert files.credentials.certificate == (good / CERTIFICATE).read_bytes()
    assert files.credentials.key == (good / KEY).read_bytes()
    assert files.credentials.ca == authority.pem
    life = files.lifetimes[str(good / CERTIFICATE)]
    assert life.end - life.begin == (91 * DAY).total_seconds()
    assert files.lifetimes[str(good / CA)].end > life.end


@pytest.mark.parametrize("ends", [-DAY, 90 * DAY])
def test_a_lifetime_that_is_over_or_has_not_begun_is_read(
    authority: Authority, tmp_path: Path, ends: timedelta
) -> None:
    """The clock of a robot may be wrong at its start. Its nodes still need the proxy."""
    begins = ends - DAY
    folder = authority.write(tmp_path / "other", begins=begins, ends=ends)
    life = read_link_files(settings(folder)).lifetimes[str(folder / CERTIFICATE)]
    assert life.end - life.begin == DAY.total_seconds()


def test_a_chain_ends_with_its_first_certificate(good: Path) -> None:
    middle = Authority("middle", days=20)
    middle.write(good, "cloud.example")
    with (good / CERTIFICATE).open("ab") as file:
        file.write(middle.pem)
    lifetimes = read_link_files(settings(good)).lifetimes
    life = lifetimes[str(good / CERTIFICATE)]
    assert life.end - life.begin == (21 * DAY).total_seconds()


@pytest.mark.parametrize(
    ("file", "option"),
    [(CERTIFICATE, "--zenoh-certificate"), (KEY, "--zenoh-key"), (CA, "--zenoh-ca")],
)
def test_a_file_that_can_not_be_read(good: Path, file: str, option: str) -> None:
    (good / file).unlink()
    assert fault(good) == f"{option} {file} can't be read: No such file or directory"
    (good / file).mkdir()
    assert fault(good) == f"{option} {file} can't be read: Is a directory"
    (good / file).rmdir()
    (good / file).write_bytes(b"x" * 1024 * 1024 + b"x")
    assert fault(good) == f"{option} {file} is longer than 1048576 bytes"
    (good / file).write_text("no certificate\n")
    told = "has no key as PEM that can be used" if file == KEY else "has no certificate as PEM"
    assert fault(good).startswith(f"{option} {file} {told}")


def test_a_file_without_permission_names_the_user(
    good: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr("builtins.open", refuse)
    user = f"let user {os.getuid()}, as which the proxy runs, read it"
    assert fault(good) == f"--zenoh-certificate {CERTIFICATE} can't be read: {user}"


def test_a_broken_certificate(good: Path) -> None:
    text = (good / CERTIFICATE).read_text()
    (good / CERTIFICATE).write_text(text[:200] + text[260:])
    assert fault(good).startswith(f"--zenoh-certificate {CERTIFICATE} has no certificate as PEM: ")


def test_a_key_of_another_certificate(good: Path, authority: Authority, tmp_path: Path) -> None:
    other = authority.write(tmp_path / "other")
    (good / KEY).write_bytes((other / KEY).read_bytes())
    told = f"--zenoh-key {KEY} does not belong to the certificate"
    assert fault(good) == told


def test_a_key_with_a_passphrase(good: Path) -> None:
    text = (good / KEY).read_text().replace("PRIVATE KEY", "ENCRYPTED PRIVATE KEY")
    (good / KEY).write_text(text)
    assert fault(good).startswith(f"--zenoh-key {KEY} has a passphrase")


def test_a_ca_that_is_none(good: Path) -> None:
    (good / CA).write_bytes((good / CERTIFICATE).read_bytes())
    told = f"--zenoh-ca {CA} has no certificate of a CA (CA:TRUE)"
    assert fault(good) == told


@pytest.mark.parametrize(("role", "usage"), [("clients", SERVERS), ("servers", CLIENTS)])
def test_a_certificate_for_the_other_role(
    authority: Authority, tmp_path: Path, role: str, usage: Any
) -> None:
    folder = authority.write(tmp_path / "other", "cloud.example", usage=usage)
    assert f"{CERTIFICATE} has no certificate for {role} of TLS" in fault(folder, role)


def test_a_key_for_which_there_is_no_cipher(good: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a key of DSA, OpenSSL ends the handshake."""
    error = ssl.SSLError(1, "[SSL: NO_SHARED_CIPHER] no shared cipher")
    error.reason = "NO_SHARED_CIPHER"

    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(checks, "_shown_certificate", fail)
    assert fault(good).endswith("has no certificate for clients of TLS: NO_SHARED_CIPHER")


def test_the_ca_itself_is_no_certificate_of_a_site(tmp_path: Path) -> None:
    folder = Authority().write(tmp_path / "other", own=True)
    assert f"{CERTIFICATE} begins with the certificate of a CA" in fault(folder)


def test_other_curves_are_read(authority: Authority, tmp_path: Path) -> None:
    folder = authority.write(tmp_path / "other", curve=ec.SECP384R1())
    assert read_link_files(settings(folder)).lifetimes


def test_the_commands_of_the_guide(tmp_path: Path) -> None:
    guide = Path(__file__).parents[3] / "docs/guide/zenoh.md"
    section = guide.read_text().partition("## A link between sites")[2]
    (commands, *_) = re.findall(r"```sh\n(.*?)```", section, re.DOTALL)
    without_root = re.sub(r"chown .*", "true", commands)
    subprocess.run(["sh", "-ec", without_root], cwd=tmp_path, check=True, capture_output=True)
    assert read_link_files(settings(tmp_path / "link/cloud", "servers")).lifetimes
    assert read_link_files(settings(tmp_path / "link/robot")).lifetimes
