"""Settings: accepted values, and errors that name the option."""

from ipaddress import ip_network
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.policy.rules import format_rules
from rosproxy.shared.ports import PortMap, PortRange
from rosproxy.shared.setting_kinds import LinkPort, SettingError
from tests.run_options import parse_settings, settings_of

GIVEN: dict[str, Any] = {
    "master_uri": "http://robot:11311",
    "advertise_host": "robot-host",
    "port_range": "45000-45099",
}

HASH = "9f9f5111f7b27a781f1f1ddde5ebc2dd2b796bfc7365c9c28b548e564176929f"
"""``printf %s 0123456789abcdef | sha256sum``"""


PRIVATE = "-----BEGIN PRIVATE KEY-----\nQUFB\n-----END PRIVATE KEY-----\n"
CERTIFICATE = "-----BEGIN CERTIFICATE-----\nQkJC\nQ0M=\n-----END CERTIFICATE-----\n"


def test_the_defaults() -> None:
    settings = parse_settings(GIVEN)
    both = PortRange(45000, 45099)
    assert settings.master_uri == "http://robot:11311"
    assert settings.ports == PortMap(both, both)
    assert settings.admin == HostPort("127.0.0.1", 11312)
    assert (settings.master_port, settings.publish_master) == (11311, None)
    assert settings.inside_networks == ()
    assert (settings.master_address, settings.admin_token) == (None, None)
    assert (settings.probe_interval, settings.probe_timeout) == (5, 3)
    assert (settings.cleanup_after, settings.linger, settings.master_interval) == (30, 30, 2)
    assert settings.log_level == "info"
    assert (settings.bind, settings.slave_control, settings.data_plane) == (
        "0.0.0.0",
        "any",
        "auto",
    )


GOOD = [
    # option, value given, field, value held
    ("master_uri", "http://10.0.0.9:11311/", "master_uri", "http://10.0.0.9:11311/"),
    ("master_uri", "http://[fd00::9]:11311", "master_uri", "http://[fd00::9]:11311"),
    ("advertise_host", "192.168.1.5", "advertise_host", "192.168.1.5"),
    ("advertise_host", "fd00::1", "advertise_host", "fd00::1"),
    ("advertise_host", "[fd00::1]", "advertise_host", "fd00::1"),
    ("advertise_host", "Robot_1.example.com", "advertise_host", "Robot_1.example.com"),
    ("master_port", 1, "master_port", 1),
    ("publish_master", 65535, "publish_master", 65535),
    ("bind", "::", "bind", "::"),
    ("admin_bind", "[::1]:80", "admin", HostPort("::1", 80)),
    ("admin_bind", "0.0.0.0:80", "admin", HostPort("0.0.0.0", 80)),
    ("cleanup_after", 0.0, "cleanup_after", 0.0),
    ("linger", 0, "linger", 0.0),
    ("probe_interval", 0.05, "probe_interval", 0.05),
    ("probe_timeout", 86400, "probe_timeout", 86400.0),
    ("slave_control", "master", "slave_control", "master"),
    ("log_level", "debug", "log_level", "debug"),
    ("log_level", "Warning", "log_level", "warning"),
    ("master_address", "192.0.2.7", "master_address", "192.0.2.7"),
    ("master_address", "::ffff:192.0.2.7", "master_address", "192.0.2.7"),
    ("master_address", "FD00::9", "master_address", "fd00::9"),
    ("master_address", "", "master_address", None),
    ("admin_token", "0123456789abcdef", "admin_token", "0123456789abcdef"),
    ("admin_token", "", "admin_token", None),
    ("admin_token", "0123456789abcdef", "token_hash", HASH),
    ("admin_token_hash", HASH, "token_hash", HASH),
    ("admin_token_hash", f" {HASH.upper()}\n", "token_hash", HASH),
    ("admin_token_hash", "", "token_hash", None),
    (
        "inside_network",
        ("10.0.0.0/24", "fd00::/64", "10.1.2.3"),
        "inside_networks",
        (ip_network("10.0.0.0/24"), ip_network("fd00::/64"), ip_network("10.1.2.3/32")),
    ),
    ("port_range", "1-1", "ports", PortMap(PortRange(1, 1), PortRange(1, 1))),
    (
        "port_range",
        " 45000 - 45001 ",
        "ports",
        PortMap(PortRange(45000, 45001), PortRange(45000, 45001)),
    ),
    (
        "advertise_port_range",
        "30000-30099",
        "ports",
        PortMap(PortRange(45000, 45099), PortRange(30000, 30099)),
    ),
]


@pytest.mark.parametrize(("option", "value", "name", "expected"), GOOD)
def test_a_good_value(option: str, value: Any, name: str, expected: Any) -> None:
    assert getattr(parse_settings({**GIVEN, option: value}), name) == expected


TIMES = ["probe_interval", "probe_timeout", "cleanup_after", "linger", "master_interval"]
NAN = float("nan")
INFINITY = float("inf")
BAD: list[tuple[str, str, list[Any]]] = [
    # option, part of the complaint, values given
    ("master_uri", "missing", [None]),
    ("master_uri", "not of the form", ["", "robot:11311", "http://robot", "http://robot:0"]),
    ("master_uri", "not of the form", ["http://robot:70000", "http://robot:x", "http://:11311"]),
    ("master_uri", "not of the form", ["https://robot:11311", "http://user@robot:11311"]),
    ("master_uri", "not of the form", ["http://[fd00::9:11311"]),
    ("master_address", "not an IP address", ["robot", "192.0.2.7:11311", "0.0.0.0", "224.0.0.1"]),
    ("master_address", "not an IP address", ["fe80::1%eth0"]),
    (
        "admin_token",
        "8 to 200",
        ["short", "with a space", "new\nline-1234", "ümlaut-1234", "x" * 201],
    ),
    ("admin_token_hash", "64 hex digits", ["0123456789abcdef", "x" * 64, f"{HASH}0"]),
    (
        "advertise_host",
        "missing; give name or address under which outside nodes and the master reach this host",
        [None],
    ),
    ("advertise_host", "neither a host name nor an address", ["", "robot:45000", "http://robot"]),
    ("advertise_host", "neither a host name nor an address", ["ro bot", "user@robot", "robot/x"]),
    ("advertise_host", "neither a host name nor an address", ["fd00::x", "[]"]),
    ("port_range", "not a range", ["", "45000", "45000-", "-45000", "45000-45010-45020", "a-b"]),
    ("port_range", "not a range", ["45000:45010", "9" * 5000 + "-1", "\u0664-\u0665"]),
    ("port_range", "must rise", ["45010-45000"]),
    ("port_range", "between 1 and 65535", ["0-10", "65000-65536"]),
    ("port_range", "", ["11000-12000"]),
    ("advertise_port_range", "has 11 ports and --port-range 45000-45099 has 100", ["30000-30010"]),
    ("advertise_port_range", "not a range", ["x"]),
    ("advertise_port_range", "between 1 and 65535", ["65500-65600"]),
    ("master_port", "not in the range 1<=x<=65535", [0, 65536, -1]),
    ("master_port", "lies in --port-range 45000-45099", [45050]),
    ("publish_master", "not in the range 1<=x<=65535", [0]),
    ("publish_master", "lies in --port-range", [45099]),
    ("publish_master", "taken by --master-port", [11311]),
    ("bind", "not an IP address", ["robot-host", ""]),
    ("admin_bind", "not of the form", ["11312", "127.0.0.1", ":11312", "127.0.0.1:0"]),
    ("admin_bind", "not of the form", ["127.0.0.1:99999"]),
    ("admin_bind", "lies in --port-range", ["127.0.0.1:45000"]),
    ("admin_bind", "taken by --master-port", ["127.0.0.1:11311"]),
    ("inside_network", "'10.0.0.0/33' is not a network", [("10.0.0.0/33",)]),
    ("inside_network", "host bits", [("10.0.0.0/24", "10.0.0.5/24")]),
    ("inside_network", "is not a network", [("docker0",)]),
    *((name, "is not between", [-1, 86401, -0.001, NAN, INFINITY]) for name in TIMES),
    *((name, "is not between", [0]) for name in ("probe_interval", "probe_timeout")),
    ("master_interval", "is not between 0.05 and 86400", [0.01]),
]


def test_a_token_and_a_hash_do_not_go_together() -> None:
    with pytest.raises(SettingError, match="--admin-token-hash: give either this or --admin-token"):
        parse_settings({**GIVEN, "admin_token": "0123456789abcdef", "admin_token_hash": HASH})


@pytest.mark.parametrize(
    ("name", "value", "complaint"),
    [
        ("ros2_lan_relay", "172.17.0.1:7500", "a LAN relay is for one domain"),
        ("ros2_peer", ("robot", "other:11400"), "other:11400 has a port, which is for one domain"),
    ],
)
def test_what_has_one_port_is_for_one_domain(name: str, value: object, complaint: str) -> None:
    given = {**GIVEN, "ros": ("2",), "ros2_lan_relay_secret": "0123456789abcdef", name: value}
    parse_settings({**given, "ros2_domain": (1,)})
    with pytest.raises(SettingError, match=complaint) as caught:
        parse_settings({**given, "ros2_domain": (0, 1)})
    assert caught.value.option == "--" + name.replace("_", "-")


def test_rmw_zenoh_alone_needs_neither_master_nor_advertised_host() -> None:
    settings = parse_settings({"ros": ("zenoh",), "zenoh_peer": ("robot", "[fd00::7]:7448")})
    assert settings.zenoh_peer == (HostPort("robot", 7447), HostPort("fd00::7", 7448))
    assert settings.range_versions == ()
    listeners = dict.fromkeys(port for _, port in settings.zenoh_listeners())
    assert [*listeners] == [*range(7448, 7468)]
    hub = parse_settings({"ros": ("zenoh",), "zenoh_hub_listen": 7447})
    assert ("--zenoh-hub-listen", 7447) in hub.zenoh_listeners()
    both = parse_settings({**GIVEN, "ros": ("1", "zenoh"), "zenoh_listen": 7447})
    assert both.range_versions == ("1",)
    assert ("--zenoh-listen", 7447) in both.zenoh_listeners()
    assert not [*parse_settings(GIVEN).zenoh_listeners()]


LINKED = {
    "ros": ("zenoh",),
    "zenoh_link": ("tls/cloud.example", "quic/[fd00::7]:7448"),
    "zenoh_certificate": "/c/tls.crt",
    "zenoh_key": "/c/tls.key",
    "zenoh_ca": "/c/ca.crt",
}


def test_links_between_sites_have_a_protocol_and_files() -> None:
    settings = parse_settings(
        {
            **LINKED,
            "zenoh_link_listen": "tls/7447",
            "zenoh_limit": ("/camera/**=2Hz", "/scan=0.5"),
            "zenoh_link_policy": ("allow publish /scan; deny publish *",),
        }
    )
    assert [*map(str, settings.zenoh_link)] == ["tls/cloud.example:7447", "quic/[fd00::7]:7448"]
    assert settings.zenoh_link_listen == LinkPort("tls", 7447)
    assert [*map(str, settings.zenoh_limit)] == ["/camera/**=2Hz", "/scan=0.5Hz"]
    assert ("--zenoh-link-listen", 7447) in settings.zenoh_listeners()
    (layer,) = settings.link_policy
    assert [*map(str, layer.rules)] == ["allow publish /scan", "deny publish *"]
    assert not parse_settings(GIVEN).has_site_links
    variables = {"ROSPROXY_ROS": "zenoh", "ROSPROXY_ZENOH_LINKS": "tls/a quic/b:1"}
    with pytest.raises(SettingError, match="--zenoh-certificate: missing"):
        settings_of(variables)


@pytest.mark.parametrize("missing", ["zenoh_certificate", "zenoh_key", "zenoh_ca"])
def test_a_link_needs_all_files(missing: str) -> None:
    with pytest.raises(SettingError, match=f"--{missing.replace('_', '-')}: missing"):
        parse_settings({**LINKED, missing: None})
    alone = {**LINKED, "zenoh_link": (), "zenoh_link_listen": "tls/7447", missing: None}
    with pytest.raises(SettingError, match=f"--{missing.replace('_', '-')}: missing"):
        parse_settings(alone)


@pytest.mark.parametrize(
    ("name", "value", "complaint"),
    [
        ("zenoh_ports", "7000-7256", "--zenoh-ports: 7000-7256 has 257 ports; give at most 256"),
        ("zenoh_ports", "11311-11311", "--zenoh-ports: port 11311 is taken by --master-port"),
        ("zenoh_ports", "45090-45110", "--zenoh-ports: port 45090 lies in --port-range"),
        ("zenoh_listen", 7450, "--zenoh-listen: port 7450 is taken by --zenoh-ports"),
        ("zenoh_listen", 0, "--zenoh-listen: 0 is not in the range"),
        ("zenoh_peer", ("robot:x",), "--zenoh-peer: 'robot:x' is not of the form HOST or HOST"),
        ("zenoh_peer", tuple(f"h{n}" for n in range(65)), "--zenoh-peer: 65 routers; give at"),
        ("zenoh_hub", tuple(f"h{n}" for n in range(129)), "--zenoh-hub: 129 proxies; give at"),
        ("zenoh_link", ("cloud",), "--zenoh-link: 'cloud' is not of the form tls/HOST or tls/"),
        ("zenoh_link", ("tcp/cloud",), "--zenoh-link: 'tcp/cloud' is not of the form tls/HOST"),
        ("zenoh_link", ("tls/a:b",), "--zenoh-link: 'tls/a:b' is not of the form tls/HOST or"),
        ("zenoh_link", ("tls/cloud",), "--zenoh-certificate: missing; links between sites need"),
        ("zenoh_link", tuple(f"tls/h{n}" for n in range(17)), "--zenoh-link: 17 links; give at"),
        ("zenoh_link_listen", "7447", "--zenoh-link-listen: '7447' is not of the form tls/PORT"),
        ("zenoh_link_listen", "tls/0", "--zenoh-link-listen: 'tls/0' is not of the form tls/"),
        ("zenoh_link_listen", "tls/7450", "--zenoh-link-listen: port 7450 is taken by --zenoh-p"),
        ("zenoh_limit", ("/camera/*",), "--zenoh-limit: '/camera/*' is not of the form TOPIC="),
        ("zenoh_limit", ("/camera/*=0",), "--zenoh-limit: '/camera/*=0' is not of the form TOP"),
        ("zenoh_limit", ("camera=nan",), "--zenoh-limit: 'camera=nan' is not of the form TOPIC"),
        ("zenoh_limit", (f"/{'a' * 256}=1",), "--zenoh-limit: a topic must have at most 256"),
        ("zenoh_limit", tuple(f"/t{n}=1" for n in range(65)), "--zenoh-limit: 65 limits; give"),
        ("zenoh_link_policy", ("deny all *",), "--zenoh-link-policy: rule 'deny all *'"),
    ],
)
def test_what_rmw_zenoh_can_not_have(name: str, value: object, complaint: str) -> None:
    with pytest.raises(SettingError) as caught:
        parse_settings({**GIVEN, "ros": ("1", "zenoh"), name: value})
    assert str(caught.value).startswith(complaint)


@pytest.mark.parametrize(
    ("text", "is_valid"),
    [
        (f"{PRIVATE}\n{CERTIFICATE}{CERTIFICATE}", True),
        (f"# of node 1\n{PRIVATE.replace('PRIV', 'EC PRIV')}{CERTIFICATE}\n\n{CERTIFICATE}", True),
        (f"{CERTIFICATE}{CERTIFICATE}{PRIVATE}", False),
        (f"{PRIVATE}{CERTIFICATE}", False),
        (f"{PRIVATE}{CERTIFICATE * 3}", False),
        (f"{PRIVATE.replace('PRIVATE', 'PUBLIC')}{CERTIFICATE * 2}", False),
        (f"{' ' * 40_000}{PRIVATE}{CERTIFICATE * 2}", False),
        ("secret", False),
    ],
)
def test_a_hubs_certificate_is_a_key_a_certificate_and_a_ca(text: str, is_valid: bool) -> None:
    variables = {"ROSPROXY_ROS": "zenoh", "ROSPROXY_ZENOH_HUB_CERTIFICATE": text}
    if not is_valid:
        with pytest.raises(SettingError) as caught:
            settings_of(variables)
        assert str(caught.value).startswith("--zenoh-hub-certificate: must be three blocks of PEM")
        assert "QUFB" not in str(caught.value)
        return
    settings = settings_of(variables)
    assert settings.zenoh_hub_certificate is not None
    assert settings.zenoh_hub_certificate.certificate == CERTIFICATE.encode()
    assert b"PRIVATE" in settings.zenoh_hub_certificate.key
    assert "QUFB" not in repr(settings)


def test_no_certificate_is_an_empty_text() -> None:
    settings = settings_of({"ROSPROXY_ROS": "zenoh", "ROSPROXY_ZENOH_HUB_CERTIFICATE": ""})
    assert settings.zenoh_hub_certificate is None


@pytest.mark.parametrize(
    "given",
    [
        {"ros": ("zenoh",), "zenoh_ports": "11300-11311"},
        {"ros": ("zenoh",), "zenoh_ports": "11000-11010"},
        {"ros": ("zenoh",), "zenoh_listen": 11311, "publish_master": 7448},
        {"ros": ("2",), "advertise_host": "robot-host", "port_range": "11300-11311"},
    ],
)
def test_ports_of_ros_versions_that_the_proxy_does_not_serve_are_free(
    given: dict[str, Any],
) -> None:
    parse_settings(given)


def test_a_lan_relay_needs_a_secret() -> None:
    """Other programs may have the relay's address. The error names the missing option."""
    given = {**GIVEN, "ros": ("2",), "ros2_lan_relay": "172.17.0.1:7500"}
    expected = (
        "--ros2-lan-relay-secret: missing; give this option and rosproxy lan-relay --secret the"
    )
    with pytest.raises(SettingError, match=expected):
        parse_settings(given)
    secret = "0123456789abcdef"
    settings = parse_settings({**given, "ros2_lan_relay_secret": secret})
    assert settings.ros2_lan_relay_secret == secret
    assert secret not in repr(settings)


@pytest.mark.parametrize(
    ("name", "complaint", "value"),
    [(name, complaint, value) for name, complaint, values in BAD for value in values],
)
def test_a_bad_value_names_its_option(name: str, complaint: str, value: Any) -> None:
    with pytest.raises(SettingError) as caught:
        parse_settings({**GIVEN, name: value})
    message = str(caught.value)
    option = "--" + name.replace("_", "-")
    assert complaint in message
    assert message.startswith(caught.value.option + ": ")
    assert "\n" not in message
    if complaint:
        assert caught.value.option == option
    else:  # two options that don't go together: either
        assert option in message


@given(
    st.sampled_from(["master_uri", "advertise_host", "port_range", "bind", "admin_bind"]), st.text()
)
def test_any_text_is_accepted_or_refused_in_one_line(name: str, text: str) -> None:
    message = ""
    try:
        parse_settings({**GIVEN, name: text})
    except SettingError as error:
        message = str(error)
    assert len(message.splitlines()) <= 1


def test_policy_comes_from_a_variable_as_one_text() -> None:
    settings = settings_of(
        {
            "ROS_MASTER_URI": "http://robot:11311",
            "ROSPROXY_ADVERTISE_HOST": "host",
            "ROSPROXY_POLICY": "allow publish /a/* ; deny publish * by /b\n# no more",
            "ROSPROXY_POLICY_MODE": "audit",
            "ROSPROXY_POLICY_LAYERS": '[{"name": "web", "rules": ["deny serve *"]}]',
        }
    )
    (own,) = settings.policy
    (told,) = settings.policy_layers
    assert (own.name, own.mode.value) == ("--policy", "audit")
    assert format_rules(own.rules) == "allow publish /a/*; deny publish * by /b"
    assert (told.name, format_rules(told.rules)) == ("web", "deny serve *")


def test_too_many_rules_are_refused() -> None:
    with pytest.raises(SettingError, match="the policy has 1001 rules"):
        parse_settings(
            {
                "master_uri": "http://robot:11311",
                "advertise_host": "host",
                "policy": "deny serve *;" * 1001,
            }
        )
