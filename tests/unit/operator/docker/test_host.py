"""Ports and addresses from the operating system."""

import socket
from pathlib import Path

import pytest

from rosproxy.shared.ports import PortRange
from rosproxy_operator.docker import host

TCP = """\
  sl  local_address rem_address   st tx_queue rx_queue tr tm->when retrnsmt   uid  timeout inode
   0: 00000000:2CAD 00000000:0000 0A 00000000:00000000 00:00000000 00000000     0        0 74187
   1: 0100007F:1F90 0100007F:9C4A 01 00000000:00000000 00:00000000 00000000     0        0 74188
"""
TCP6 = """\
  sl  local_address                         remote_address                        st
   0: 00000000000000000000000000000000:0016 00000000000000000000000000000000:0000 0A
"""


def test_only_listening_sockets_count() -> None:
    assert host.parse_listening(TCP) == {11437}
    assert host.parse_listening(TCP6) == {22}
    assert host.parse_listening("") == frozenset()


@pytest.mark.parametrize(("text", "last"), [("32768\t40000\n", 40000), (None, 60999)])
def test_the_ephemeral_range(text: str | None, last: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Or the kernel's default if the file is missing."""

    def read(*_: object, **__: object) -> str:
        if text is None:
            raise FileNotFoundError
        return text

    monkeypatch.setattr(Path, "read_text", read)
    assert host.ephemeral_ports() == PortRange(32768, last)


def test_a_socket_that_listens_is_seen() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        assert server.getsockname()[1] in host.listening_ports()


def test_own_addresses() -> None:
    assert host.is_own_address("127.0.0.1")
    assert not host.is_own_address("192.0.2.77")


@pytest.fixture
def routes(monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """The source address of connections to each address; 10.0.0.7 for all others."""
    source_addresses: dict[str, str] = {}
    monkeypatch.setattr(host, "address_towards", lambda to: source_addresses.get(to, "10.0.0.7"))
    return source_addresses


def test_the_address_towards_a_master(routes: dict[str, str]) -> None:
    routes["192.168.1.5"] = "192.168.1.2"
    assert host.own_address_towards("192.168.1.5", ()) == "192.168.1.2"


def test_towards_a_container_it_is_the_address_that_others_know(routes: dict[str, str]) -> None:
    routes["172.18.0.5"] = routes["172.18.0.1"] = "172.18.0.1"
    assert host.own_address_towards("172.18.0.5", ["172.18.0.1"]) == "10.0.0.7"
    assert host.own_address_towards("172.18.0.1", ["172.18.0.1"]) == "10.0.0.7"


def test_a_host_without_other_networks_is_known_by_its_gateway(routes: dict[str, str]) -> None:
    routes["172.18.0.5"] = "172.18.0.1"
    routes["192.0.2.1"] = "127.0.0.1"
    assert host.own_address_towards("172.18.0.5", ["172.18.0.1"]) == "172.18.0.1"


def test_no_route_no_address(routes: dict[str, str]) -> None:
    routes["10.9.9.9"] = routes["192.0.2.1"] = "127.0.0.1"
    assert host.own_address_towards("10.9.9.9", ()) == ""
