"""The router of the links to other sites: what it dials, and what passes."""

import base64
import json
from typing import Any

import pytest

from rosproxy.shared.addresses import HostPort
from rosproxy.shared.policy.layers import PolicyLayer
from rosproxy.shared.policy.rules import parse_rules
from rosproxy.shared.ports import PortRange
from rosproxy.shared.setting_kinds import Credentials, LinkPort, SiteLink, TopicLimit
from rosproxy.shared.zenoh_rules.key_expressions import check_limits
from rosproxy.zenoh.link_router import LinkPlan
from rosproxy.zenoh.router_configs import RouterPlan

CREDENTIALS = Credentials(b"certificate", b"secret key", b"authority")
PLAN = RouterPlan("0.0.0.0", PortRange(7448, 7449), None, (), "/dev/shm/sockets")
LINK = SiteLink("tls", HostPort("cloud.example", 7447))


def config(
    listen: LinkPort | None = None, limits: tuple[TopicLimit, ...] = (), rules: str = ""
) -> dict[str, Any]:
    policy = (PolicyLayer("links", parse_rules(rules)),) if rules else ()
    plan = LinkPlan("0.0.0.0", (LINK,), listen, limits, policy)
    made = plan.config(CREDENTIALS, PLAN.hub_socket)
    return {key: json.loads(value) for key, value in made.items()}


def test_the_router_dials_the_site_and_the_hub() -> None:
    made = config()
    hub = "unixsock-stream//dev/shm/sockets/hub"
    assert made["connect/endpoints"] == [
        f"{hub}#retry_period_init_ms=50",
        "tls/cloud.example:7447",
    ]
    assert made["listen/endpoints"] == []
    plan = LinkPlan("0.0.0.0", (LINK,), None, (), ())
    *containers, links, at_hub = PLAN.configs({}, plan.config(CREDENTIALS, PLAN.hub_socket))
    assert len(containers) == 2
    assert "tls/cloud.example:7447" in links["connect/endpoints"]
    assert json.loads(at_hub["listen/endpoints"]) == [hub]
    assert not json.loads(PLAN.configs({})[-1]["listen/endpoints"])


def test_both_sides_have_to_show_certificates() -> None:
    made = config(LinkPort("quic", 7447))
    tls = {key.rpartition("/")[2]: value for key, value in made.items() if "/tls/" in key}
    assert tls["enable_mtls"]
    assert tls["verify_name_on_connect"]
    assert tls["close_link_on_expiration"]
    for side in ("listen", "connect"):
        assert base64.b64decode(tls[f"{side}_certificate_base64"]) == b"certificate"
        assert base64.b64decode(tls[f"{side}_private_key_base64"]) == b"secret key"
    assert base64.b64decode(tls["root_ca_certificate_base64"]) == b"authority"
    assert "secret" not in repr(CREDENTIALS)


def test_a_port_that_can_not_be_opened_does_not_end_the_other_routers() -> None:
    made = config(LinkPort("tls", 7447))
    assert made["listen/endpoints"] == ["tls/0.0.0.0:7447"]
    assert made["listen/exit_on_failure"] is False


def test_limits_hold_for_what_leaves_by_links() -> None:
    made = config(limits=(TopicLimit("/camera/**", 2.0), TopicLimit("/scan", 0.5)))
    (rule,) = made["downsampling"]
    assert rule["link_protocols"] == ["tls", "quic"]
    assert rule["flows"] == ["egress"]
    assert rule["rules"] == [
        {"key_expr": "*/camera/*/*/*/**", "freq": 2.0},
        {"key_expr": "*/scan/*/*", "freq": 0.5},
    ]
    assert "downsampling" not in config()


@pytest.mark.parametrize(
    ("glob", "complaint"),
    [
        ("/cam?ra", "rmw_zenoh has no"),
        ("/a*b", "write . for whole parts of a name"),
        ("/a//b", "no topic of ROS 2 has such a name"),
        ("/a#b", "no topic of ROS 2 has such a name"),
        ("/", "no topic of ROS 2 has such a name"),
    ],
)
def test_limits_that_zenoh_can_not_count(glob: str, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        check_limits((TopicLimit("/scan", 1.0), TopicLimit(glob, 2.0)))


@pytest.mark.parametrize("glob", ["/camera/**", "/camera/*", "/cam*", "/*/image", "*/image", "*"])
def test_limits_with_stars(glob: str) -> None:
    check_limits((TopicLimit(glob, 2.0),))


def test_rules_for_links_check_tls_and_quic() -> None:
    made = config(rules="deny publish /private")
    control = made["access_control"]
    assert control["default_permission"] == "deny"
    assert control["subjects"] == [
        {"id": "nodes", "link_protocols": ["unixsock-stream"]},
        {"id": "hub", "link_protocols": ["tls", "quic"]},
    ]
    assert "access_control" not in config()
