"""Links of rmw_zenoh to other sites (``spec.link``): the spec, the proxies, conditions, Events."""

from typing import Any

import pytest
from msgspec.structs import replace

from rosproxy.shared.documents.status_document import (
    ProxyStatus,
    StatusSettings,
    ZenohLinkStatus,
    ZenohStatus,
)
from rosproxy.shared.policy.rules import parse_rules
from rosproxy.shared.zenoh_rules.key_expressions import check_limits
from rosproxy.shared.zenoh_rules.name_sets import check_layers
from rosproxy_operator.kubernetes.planner import manifests
from rosproxy_operator.kubernetes.planner.actions import DeleteProxy, Emit
from rosproxy_operator.kubernetes.planner.bounds import bounds_violation
from rosproxy_operator.kubernetes.proxies.proxy_report import report
from rosproxy_operator.kubernetes.resources import names
from rosproxy_operator.kubernetes.resources.cluster import ProxyReport, ZenohReport
from rosproxy_operator.kubernetes.resources.fields import InvalidField
from rosproxy_operator.kubernetes.resources.model import Json, LinkSpec, RosProxy, ZenohSpec
from rosproxy_operator.kubernetes.settings import Bounds
from rosproxy_operator.kubernetes.status.condition_findings import cluster_findings
from tests.run_options import settings_of
from tests.unit.operator.kubernetes import objects as some
from tests.unit.operator.kubernetes.builders_api import rosproxy_obj
from tests.unit.operator.kubernetes.objects import SETTINGS, done, look, node, site, status, told
from tests.unit.operator.kubernetes.test_zenoh import (
    answered,
    conditions,
    env_of,
    ofz,
    proxy_of,
    seen,
    specified,
)

CLOUD = "tls/cloud.example:7447"
RULES = parse_rules("allow publish /status; deny publish *")
LINK = LinkSpec((CLOUD,), "link", ("/camera/image=2Hz",), RULES)
GIVEN: dict[str, Any] = {
    "to": ["tls/Cloud.example", CLOUD],
    "secretName": "link",
    "limits": ["/camera/image=2"],
    "policy": ["allow publish /status", "deny publish *"],
}


def joined(link: LinkSpec = LINK, **changes: Any) -> RosProxy:
    return ofz(zenoh=ZenohSpec(link=link), **changes)


def place(of: RosProxy) -> manifests.ProxySite:
    return site(of, node(), names.ROUTERS)


def linked(fault: str = "", link: str = CLOUD) -> ProxyReport:
    """The answer of a proxy with a link to another site."""
    return ProxyReport(True, True, zenoh=ZenohReport(sites={link: fault}))


def test_what_is_read() -> None:
    assert specified(ros="zenoh", link=GIVEN).zenoh.link == LINK
    least = specified(ros="zenoh", link={"to": ["quic/[fd00::7]:7448"], "secretName": "a.b"})
    assert least.zenoh.link == LinkSpec(("quic/[fd00::7]:7448",), "a.b")
    assert specified(ros="zenoh").zenoh.link is None


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"to": []}, "spec.link.to: [] is empty. Write the other sites"),
        ({"to": ["cloud.example"]}, "spec.link.to: 'cloud.example' is not of the form tls/HOST"),
        ({"to": ["tcp/cloud.example:7447"]}, "is not of the form tls/HOST"),
        ({"to": ["tls/localhost"]}, "a loopback address, which means the proxy itself"),
        ({"to": [f"tls/site-{n}" for n in range(17)]}, "has too many entries. Write at most 16"),
        ({"secretName": None}, "spec.link.secretName: None can't be the name of a Secret"),
        ({"secretName": "a/b"}, "spec.link.secretName: 'a/b' can't be the name of a Secret"),
        ({"limits": ["/a"]}, "spec.link.limits: '/a' is not of the form TOPIC=RATEHz"),
        ({"limits": ["/a b=2"]}, "spec.link.limits: '/a b=2' has a blank"),
        ({"limits": ["/a*b=2"]}, "spec.link.limits: /a*b=2Hz: write *"),
        ({"limits": [f"/{n}=1" for n in range(65)]}, "spec.link.limits: "),
        ({"policy": ["deny"]}, "spec.link.policy: rule 'deny': must be ACTION KIND GLOB"),
        ({"policy": ["deny publish /a; deny serve *"]}, "has a semicolon"),
        (
            {"policy": ["allow publish /a/b", "deny publish /a/*"]},
            "spec.link.policy: layer 'spec.link.policy': ",
        ),
    ],
)
def test_what_is_refused(change: dict[str, Any], text: str) -> None:
    with pytest.raises(InvalidField) as refused:
        specified(ros="zenoh", link=GIVEN | change)
    assert text in str(refused.value)


def test_the_field_is_for_rmw_zenoh_alone() -> None:
    with pytest.raises(InvalidField, match=r"spec\.link: .* is for rmw_zenoh, but spec.ros is 2"):
        specified(ros=2, link=GIVEN)


@pytest.mark.parametrize(
    ("patterns", "aliases", "refused"),
    [
        ((), (), False),
        (("cloud.*",), (), False),
        (("robot",), (), True),
        (("cloud.*",), ({"ip": "192.0.2.7", "hostnames": ["cloud.example"]},), True),
    ],
)
def test_the_administrator_allows_hosts_as_for_peers(
    patterns: tuple[str, ...], aliases: tuple[Json, ...], refused: bool
) -> None:
    settings = replace(SETTINGS, bounds=Bounds(peers=patterns))
    text = str(bounds_violation(joined(host_aliases=aliases), {}, settings) or "")
    assert bool(text) is refused
    if refused:
        assert text.startswith("spec.link.to: the operator does not allow 'cloud.example:7447'")
        assert "allow.peers" in text


def test_the_proxy_gets_the_links_and_the_files() -> None:
    body: Any = manifests.proxy_pod(place(joined()), SETTINGS)
    (volume,) = body["spec"]["volumes"]
    files = ["tls.crt", "tls.key", "ca.crt"]
    items = [{"key": name, "path": name} for name in files]
    assert volume == {
        "name": "link",
        "secret": {"secretName": "link", "items": items, "optional": True},
    }
    (mount,) = body["spec"]["containers"][0]["volumeMounts"]
    assert mount == {"name": "link", "mountPath": "/etc/rosproxy/link", "readOnly": True}
    settings = settings_of(env_of(body))
    assert list(map(str, settings.zenoh_link)) == [CLOUD]
    assert settings.zenoh_certificate == "/etc/rosproxy/link/tls.crt"
    assert settings.zenoh_key == "/etc/rosproxy/link/tls.key"
    assert settings.zenoh_ca == "/etc/rosproxy/link/ca.crt"
    assert list(map(str, settings.zenoh_limit)) == ["/camera/image=2Hz"]
    assert settings.link_policy[0].rules == RULES
    assert settings.zenoh_link_listen is None
    check_limits(settings.zenoh_limit)
    check_layers(settings.link_policy)


def test_a_proxy_without_links_stays_as_before() -> None:
    body: Any = manifests.proxy_pod(place(ofz()), SETTINGS)
    assert "volumes" not in body["spec"]
    assert "volumeMounts" not in body["spec"]["containers"][0]
    assert not [name for name in env_of(body) if "LINK" in name or "CERTIFICATE" in name]


@pytest.mark.parametrize("changed", [replace(LINK, secret="b"), replace(LINK, limits=())])
def test_a_change_of_the_links_recreates_the_proxies(changed: LinkSpec) -> None:
    former = proxy_of(joined())
    plan = look(seen(joined(changed), some.pod(wired_master_uri=""), former))
    assert [type(action) for action in done(plan)] == [DeleteProxy]


def test_what_the_operator_keeps_of_a_status() -> None:
    links = (
        ZenohLinkStatus("robot:7447", True),
        ZenohLinkStatus("cloud.example:7447", error="refused", protocol="tls"),
        ZenohLinkStatus("two:7447", True, hub=True),
    )
    zenoh = report(
        ProxyStatus(settings=StatusSettings(ros=("zenoh",)), zenoh=ZenohStatus(links=links))
    ).zenoh
    assert zenoh == ZenohReport(
        peers={"robot:7447": ""}, hubs={"two:7447": ""}, sites={CLOUD: "refused"}
    )


@pytest.mark.parametrize(
    ("answer", "condition", "count"),
    [
        (linked(), ("True", "Reached"), "1/1"),
        (linked("refused"), ("Unknown", "Linking"), "0/1"),
    ],
)
def test_the_condition_of_links(
    answer: ProxyReport, condition: tuple[str, str], count: str
) -> None:
    plan = look(answered(joined(), answer))
    assert conditions(plan)["SitesReachable"] == condition
    assert "PeersReachable" not in conditions(plan)
    assert status(plan)["perNode"][0]["links"] == count
    assert "SitesReachable" not in conditions(look(answered(ofz(), linked())))


@pytest.mark.parametrize(
    ("problem", "reason"),
    [
        (f"zenoh link {CLOUD}: the certificate of the other proxy has expired", "SiteUnreachable"),
        ("zenoh file /etc/rosproxy/link/tls.crt: expires within 14 days", "LinkCertificate"),
    ],
)
def test_a_fault_of_a_link_is_told_with_an_event(problem: str, reason: str) -> None:
    plan = look(answered(joined(), replace(linked(), problems=(problem,))))
    is_down = reason == "SiteUnreachable"
    expected = ("False", "SiteUnreachable") if is_down else ("True", "Reached")
    assert conditions(plan)["SitesReachable"] == expected
    assert conditions(plan)["Degraded"] == ("True", reason)
    assert conditions(plan)["Ready"] == ("True", "Serving")
    (text,) = told(plan, reason)
    assert text.endswith(problem)
    assert reason in {action.reason for action in plan.actions if isinstance(action, Emit)}
    reported = cluster_findings([{**rosproxy_obj(), "status": dict(status(plan))}])
    assert any(problem in f.text and "spec.link" in f.fix for f in reported)
