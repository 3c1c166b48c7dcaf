"""Addresses in URIs: valid URIs, other text, and the inside address in a path."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.shared.addresses import (
    HostPort,
    is_address,
    is_loopback,
    parse_address,
    parse_host_port,
    plain_address,
)
from rosproxy.shared.uris import (
    InsidePath,
    inside_path,
    parse_inside_path,
    parse_service_uri,
    parse_slave_uri,
    path_of,
    service_uri,
    slave_uri,
    with_caller_address,
)

NAMES = st.from_regex(r"[a-zA-Z0-9_]([a-zA-Z0-9_.-]{0,30}[a-zA-Z0-9_])?", fullmatch=True)
ADDRESSES = st.ip_addresses().map(str)
PORTS = st.integers(1, 65535)
PLACES = st.builds(HostPort, NAMES | ADDRESSES, PORTS)

AUTHORITIES = {
    "10.0.0.5:40001": HostPort("10.0.0.5", 40001),
    "c1:1": HostPort("c1", 1),
    "3f2a91c0b7de:65535": HostPort("3f2a91c0b7de", 65535),
    "My_Robot.local:80": HostPort("My_Robot.local", 80),
    "robot-1.example.com.:80": HostPort("robot-1.example.com.", 80),
    "größe:80": HostPort("größe", 80),
    "[::1]:80": HostPort("::1", 80),
    "[fd00::5]:80": HostPort("fd00::5", 80),
    "[::ffff:10.0.0.5]:80": HostPort("::ffff:10.0.0.5", 80),
    "[fe80::1%eth0]:80": HostPort("fe80::1%eth0", 80),
    "": None,
    ":": None,
    ":80": None,
    "c1": None,
    "c1:": None,
    "c1:0": None,
    "c1:65536": None,
    "c1:-1": None,
    "c1:+1": None,
    "c1:8o": None,
    "c1:80:80": None,
    "c1:٨٠": None,
    "c 1:80": None,
    "user@c1:80": None,
    "user:password@c1:80": None,
    "<c1>:80": None,
    'c1":80': None,
    "c1%0a:80": None,
    "::1:80": None,
    "fd00::5:80": None,
    "[::1:80": None,
    "::1]:80": None,
    "[::1]": None,
    "a[::1]:80": None,
    "c[1]:80": None,
}


@pytest.mark.parametrize(("text", "expected"), AUTHORITIES.items())
def test_host_and_port(text: str, expected: HostPort | None) -> None:
    assert parse_host_port(text) == expected
    assert parse_slave_uri(f"http://{text}/") == expected
    assert parse_slave_uri(f"http://{text}") == expected
    assert parse_slave_uri(f"http://{text}/RPC2?x#y") == expected
    assert parse_service_uri(f"rosrpc://{text}") == expected


@pytest.mark.parametrize(
    "uri",
    [
        "",
        "c1:80",
        "//c1:80",
        "https://c1:80/",
        "HTTP://c1:80/",
        "ftp://c1:80/",
        " http://c1:80/",
        "rosrpc://c1:80",
        "http:///c1:80",
        "http:c1:80",
        "constructor",
    ],
)
def test_what_is_no_slave_uri(uri: str) -> None:
    assert parse_slave_uri(uri) is None


@pytest.mark.parametrize("uri", ["", "http://c1:80/", "rosrpcs://c1:80", "rosrpc:c1:80"])
def test_what_is_no_service_uri(uri: str) -> None:
    assert parse_service_uri(uri) is None


@given(PLACES)
def test_uris_round_trip(address: HostPort) -> None:
    assert parse_host_port(str(address)) == address
    assert parse_slave_uri(slave_uri(address)) == address
    assert parse_service_uri(service_uri(address)) == address


@given(st.text())
def test_any_text_is_parsed_without_raising(text: str) -> None:
    for start in ("", "http://", "rosrpc://", "http://h:1/", "http://["):
        parse_slave_uri(start + text)
        parse_service_uri(start + text)
        parse_inside_path(start + text)
        is_loopback(start + text)
        plain_address(start + text)


@pytest.mark.parametrize(
    ("node", "address", "path"),
    [
        (HostPort("10.0.0.5", 40001), "10.0.0.5", "/10.0.0.5:40001/"),
        (HostPort("c1", 40001), "10.0.0.5", "/c1:40001/10.0.0.5/"),
        (HostPort("127.0.0.1", 40001), "10.0.0.5", "/127.0.0.1:40001/10.0.0.5/"),
        (HostPort("fd00::5", 40001), "fd00::5", "/[fd00::5]:40001/"),
        (HostPort("c1", 40001), "fd00::5", "/c1:40001/fd00::5/"),
        (HostPort("fe80::1%eth0", 40001), "fe80::1", "/[fe80::1%25eth0]:40001/fe80::1/"),
        (HostPort("größe", 40001), "10.0.0.5", "/gr%C3%B6%C3%9Fe:40001/10.0.0.5/"),
    ],
)
def test_the_inside_address_in_a_path(node: HostPort, address: str, path: str) -> None:
    inside = InsidePath(node, None if node.host == address else address)
    assert inside_path(inside) == path
    assert parse_inside_path(f"http://robot-host:45000{path}") == inside


@given(PLACES, ADDRESSES, PLACES)
def test_inside_paths_round_trip(node: HostPort, address: str, outside: HostPort) -> None:
    path_address = None if node.host == address else address
    uri = slave_uri(outside, inside_path(InsidePath(node, path_address)))
    parsed = parse_inside_path(uri)
    assert parsed is not None
    assert (parsed.node, parsed.address or parsed.node.host) == (node, address)
    assert parse_slave_uri(uri) == outside


@given(PLACES, PLACES, PLACES)
def test_the_uri_that_another_proxy_advertises_is_kept(
    node: HostPort, first: HostPort, second: HostPort
) -> None:
    """With two proxies in a row, the outer proxy's URI contains the inner proxy's whole URI."""
    inner = slave_uri(first, inside_path(InsidePath(node, "10.0.0.5")))
    outer = slave_uri(second, inside_path(InsidePath(first, "10.0.0.9", path_of(inner))))
    parsed = parse_inside_path(outer)
    assert parsed is not None
    assert slave_uri(parsed.node, parsed.path) == inner
    assert parsed.slave == HostPort("10.0.0.9", first.port)


def test_a_path_that_is_too_long_is_not_carried() -> None:
    node = HostPort("10.0.0.5", 40001)
    assert inside_path(InsidePath(node, None, f"/{'x' * 600}")) == "/10.0.0.5:40001/"


@pytest.mark.parametrize(
    "path",
    [
        "",
        "/",
        "/RPC2",
        "/c1/",
        "/c1:0/",
        "/c1:x/",
        "/:40001/",
        "/c1:40001/c2/",
        "/c1:40001/10.0.0/",
        "/c1:40001/10.0.0.5:22/",
        "/c1:40001/10.0.0.5/x/",
        "/c1:40001//10.0.0.5/",
        "/a/c1:40001/",
        "/user@c1:40001/",
    ],
)
def test_paths_without_an_inside_address(path: str) -> None:
    assert parse_inside_path(f"http://robot-host:45000{path}") is None


@pytest.mark.parametrize(
    ("host", "loopback"),
    [
        ("127.0.0.1", True),
        ("127.1.2.3", True),
        ("::1", True),
        ("::ffff:127.0.0.1", True),
        ("0.0.0.0", True),
        ("::", True),
        ("localhost", True),
        ("LocalHost", True),
        ("c1.localhost", True),
        ("10.0.0.5", False),
        ("::2", False),
        ("localhost.example.com", False),
        ("mylocalhost", False),
        ("c1", False),
        ("", False),
    ],
)
def test_hosts_that_mean_another_machine_to_everybody(host: str, loopback: bool) -> None:
    assert is_loopback(host) is loopback


@pytest.mark.parametrize(
    ("address", "plain"),
    [
        ("10.0.0.5", "10.0.0.5"),
        ("::ffff:10.0.0.5", "10.0.0.5"),
        ("::FFFF:0a00:0005", "10.0.0.5"),
        ("fe80::1%eth0", "fe80::1"),
        ("FD00:0:0::5", "fd00::5"),
        ("c1", "c1"),
        ("", ""),
    ],
)
def test_plain_addresses(address: str, plain: str) -> None:
    assert plain_address(address) == plain
    assert is_address(plain) is (plain not in ("c1", ""))


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("10.0.0.5", "10.0.0.5"),
        ("127.0.0.1", "127.0.0.1"),
        ("::ffff:10.0.0.5", "10.0.0.5"),
        ("FD00::05", "fd00::5"),
        ("::1", "::1"),
        ("0.0.0.0", None),
        ("::", None),
        ("224.0.0.1", None),
        ("fe80::1%eth0", None),
        ("10.0.0.5%eth0", None),
        ("10.0.0.0/24", None),
        ("10.0.0.5:80", None),
        ("[fd00::5]", None),
        ("c1", None),
        (" 10.0.0.5", None),
        ("", None),
    ],
)
def test_an_address_that_something_may_be_reached_at(text: str, address: str | None) -> None:
    assert parse_address(text) == address


@pytest.mark.parametrize(
    ("uri", "expected"),
    [
        ("http://:41063", "http://10.0.0.5:41063"),
        ("http://:41063/", "http://10.0.0.5:41063/"),
        ("rosrpc://:41064", "rosrpc://10.0.0.5:41064"),
        ("http://c1:41063/", "http://c1:41063/"),
        ("http://:41063/RPC2", "http://:41063/RPC2"),
        ("http://:", "http://:"),
        ("ftp://:41063", "ftp://:41063"),
        ("", ""),
    ],
)
def test_a_uri_without_a_host_is_where_it_came_from(uri: str, expected: str) -> None:
    assert with_caller_address(uri, "10.0.0.5") == expected
    if uri != expected:
        assert with_caller_address(uri, "fd00::5") == expected.replace("10.0.0.5", "[fd00::5]")
