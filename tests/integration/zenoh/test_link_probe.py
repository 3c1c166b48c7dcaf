"""The tries to connect to another site or hub by TLS: the faults that a connection shows."""

import contextlib
import socket
import ssl
import threading
from asyncio.sslproto import _SSLProtocolTransport
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rosproxy.runtime import Runtime
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.setting_kinds import Credentials, SettingError, read_hub_certificate
from rosproxy.zenoh import link_probe, stack
from rosproxy.zenoh.certificates import CLIENTS, SERVERS, check_credentials
from rosproxy.zenoh.link_probe import try_link
from rosproxy.zenoh.links import Link, LinkFault
from rosproxy.zenoh.stack import Zenoh
from rosproxy_operator.kubernetes.proxies.hub_certificate import hub_certificate
from rosproxy_operator.kubernetes.resources.model import Name
from rosproxy_operator.kubernetes.resources.names import hub_address
from tests.certificates import CA, CERTIFICATE, DAY, KEY, Authority
from tests.certificates import SERVERS as FOR_SERVERS
from tests.run_options import settings_of

HOST = "127.0.2.9"
AUTHORITY = Authority()


def context(folder: Path, kind: int) -> ssl.SSLContext:
    """Certificate and CA of a folder, for a server or a client."""
    made = ssl.SSLContext(kind)
    made.verify_mode = ssl.CERT_REQUIRED
    made.load_cert_chain(folder / CERTIFICATE, folder / KEY)
    made.load_verify_locations(folder / CA)
    return made


@contextlib.contextmanager
def site(tls: ssl.SSLContext | None, name: str = "cloud.example") -> Iterator[Link]:
    """A server that waits for the first message of zenoh, as a link to this server.

    The server has a thread, because asyncio sends no alerts of TLS.
    """
    with socket.create_server((HOST, 0)) as listening:
        thread = threading.Thread(target=serve, args=[listening, tls])
        thread.start()
        port = listening.getsockname()[1]
        try:
            yield Link(HostPort(name, port), 0.0, protocol="tls", addresses=(HOST,))
        finally:
            listening.shutdown(socket.SHUT_RDWR)
            thread.join()


def serve(listening: socket.socket, tls: ssl.SSLContext | None) -> None:
    """Accept connections until the socket is shut down, and read until each ends."""
    with contextlib.suppress(OSError):
        while True:
            conn = listening.accept()[0]
            with conn, contextlib.suppress(OSError):
                conn.settimeout(5.0)
                with tls.wrap_socket(conn, server_side=True) if tls else conn as reading:
                    reading.recv(1)


@pytest.fixture(autouse=True)
def no_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link_probe, "ALERT_TIMEOUT_S", 0.3)


@pytest.fixture(autouse=True)
def transports_of_python_3_11_2(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python 3.11.2 of Debian fails to abort a closed transport of TLS; later versions do not."""

    def abort(transport: _SSLProtocolTransport) -> None:
        assert transport._ssl_protocol is not None
        aborted(transport)

    aborted = _SSLProtocolTransport.abort
    monkeypatch.setattr(_SSLProtocolTransport, "abort", abort)


Write = Callable[[Path], object]


def cloud(folder: Path) -> None:
    AUTHORITY.write(folder, "cloud.example")


def other_name(folder: Path) -> None:
    AUTHORITY.write(folder, "other.example")


def expired(folder: Path) -> None:
    AUTHORITY.write(folder, "cloud.example", begins=-2 * DAY, ends=-DAY)


def too_early(folder: Path) -> None:
    AUTHORITY.write(folder, "cloud.example", begins=DAY, ends=2 * DAY)


def for_servers(folder: Path) -> None:
    AUTHORITY.write(folder, "cloud.example", usage=FOR_SERVERS)


def foreign(folder: Path) -> None:
    Authority("another CA").write(folder, "cloud.example")
    (folder / CA).write_bytes(AUTHORITY.pem)


def same_name(folder: Path) -> None:
    """A CA with the name of the right CA, and another key."""
    Authority().write(folder, "cloud.example")
    (folder / CA).write_bytes(AUTHORITY.pem)


@pytest.mark.parametrize(
    ("there", "here", "fault"),
    [
        (cloud, cloud, LinkFault.NO_SESSION),
        (same_name, cloud, LinkFault.PEER_FOREIGN),
        (cloud, same_name, LinkFault.OWN_FOREIGN),
        (other_name, cloud, LinkFault.PEER_OTHER_NAME),
        (expired, cloud, LinkFault.PEER_EXPIRED),
        (too_early, cloud, LinkFault.PEER_TOO_EARLY),
        (foreign, cloud, LinkFault.PEER_FOREIGN),
        (cloud, foreign, LinkFault.OWN_FOREIGN),
        (cloud, expired, LinkFault.OWN_EXPIRED),
        (cloud, for_servers, LinkFault.OWN_REFUSED),
    ],
)
async def test_what_a_handshake_shows(
    tmp_path: Path, there: Write, here: Write, fault: LinkFault
) -> None:
    there(tmp_path / "there")
    here(tmp_path / "here")
    client = context(tmp_path / "here", ssl.PROTOCOL_TLS_CLIENT)
    with site(context(tmp_path / "there", ssl.PROTOCOL_TLS_SERVER)) as link:
        assert await try_link(link, client) is fault


async def test_a_program_without_tls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cloud(tmp_path)
    monkeypatch.setattr(link_probe, "HANDSHAKE_TIMEOUT_S", 0.3)
    client = context(tmp_path, ssl.PROTOCOL_TLS_CLIENT)
    with site(None) as link:
        assert await try_link(link, client) is LinkFault.NO_TLS
        link.protocol = "tcp"
        assert await try_link(link) is LinkFault.NO_SESSION
    link.protocol = "tls"
    assert await try_link(link, client) is LinkFault.REFUSED
    link.protocol = "quic"
    assert await try_link(link, client) is LinkFault.NO_QUIC_SESSION
    link.addresses = ()
    assert await try_link(link, client) is LinkFault.UNRESOLVABLE


ZENOH = Name("robots", "zenoh")
HUB = hub_address(ZENOH, "two").host
HUB_KEY = bytes(32)


def credentials_of(key: bytes = HUB_KEY, of: Name = ZENOH) -> Credentials:
    credentials = read_hub_certificate(hub_certificate(key, of))
    assert credentials is not None
    return credentials


def hub_context(credentials: Credentials, folder: Path) -> ssl.SSLContext:
    """A server that demands a certificate of the same CA, as a hub does."""
    (folder / CERTIFICATE).write_bytes(credentials.certificate)
    (folder / KEY).write_bytes(credentials.key)
    (folder / CA).write_bytes(credentials.ca)
    return context(folder, ssl.PROTOCOL_TLS_SERVER)


@pytest.mark.parametrize(
    ("there", "name", "fault"),
    [
        (credentials_of(), HUB, LinkFault.NO_SESSION),
        (credentials_of(b"1" * 32), HUB, LinkFault.PEER_FOREIGN),
        (credentials_of(of=Name("robots", "arm")), HUB, LinkFault.PEER_OTHER_NAME),
        (credentials_of(), "hub.example", LinkFault.PEER_OTHER_NAME),
        (None, HUB, LinkFault.NO_TLS),
    ],
    ids=["same", "other key", "other RosProxy", "other name", "no certificate"],
)
async def test_what_a_handshake_with_a_hub_shows(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    there: Credentials | None,
    name: str,
    fault: LinkFault,
) -> None:
    monkeypatch.setattr(link_probe, "HANDSHAKE_TIMEOUT_S", 0.3 if there is None else 5.0)
    own = check_credentials(credentials_of(), (CLIENTS, SERVERS)).client
    with site(hub_context(there, tmp_path) if there else None, name) as link:
        link.protocol = "tcp"
        link.is_hub = True
        assert await try_link(link, own) is fault


async def test_a_key_of_another_certificate_is_refused_at_the_start(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(stack, "_check_package", lambda: None)
    own = credentials_of()
    mixed = (credentials_of(b"1" * 32).key, own.certificate, own.ca)
    variables = {
        "ROSPROXY_ROS": "zenoh",
        "ROSPROXY_BIND": HOST,
        "ROSPROXY_ZENOH_HUB_CERTIFICATE": b"".join(mixed).decode(),
    }
    zenoh = Zenoh(Runtime(settings_of(variables)))
    for start in (zenoh.start, zenoh.try_ports):
        with pytest.raises(
            SettingError, match="--zenoh-hub-certificate: the key does not belong"
        ) as caught:
            await start()
        assert "PRIVATE" not in str(caught.value)
    await zenoh.stop()
