"""The pods that may use a proxy as their master."""

from typing import Any

import pytest
from msgspec.structs import replace

from rosproxy_operator.kubernetes.resources import names, objects
from rosproxy_operator.kubernetes.resources.model import Name, Selector
from tests.unit.operator.kubernetes.builders_api import pod_obj
from tests.unit.operator.kubernetes.objects import look, node, observed, pod, proxy, rosproxy

UID = "uid-proxy-robot-one"


def who(*things: Any) -> tuple[str, ...] | None:
    return look(observed(*(things or (rosproxy(),)), proxy())).briefings[UID].callers


def test_selected_pods_on_its_node() -> None:
    local = pod("a", ip="10.244.1.5")
    remote = pod("b", on="two", ip="10.244.2.5")
    assert who(rosproxy(), local, remote) == ("10.244.1.5",)
    assert who() == ()


@pytest.mark.parametrize(
    ("changes", "may"),
    [
        ({"phase": "Pending"}, True),  # as soon as the pod has an address
        ({"phase": "Pending", "ip": ""}, False),
        ({"deleting": True}, True),  # the nodes unregister at their end
        ({"phase": "Succeeded"}, False),
        ({"host_network": True}, False),
        ({"labels": {}}, False),
        ({"labels": {names.INJECT: "false"}}, False),
        ({"labels": {names.INJECT: "arm"}}, False),
        ({"id": Name("other", "talker")}, False),
    ],
)
def test_which_pods_count(changes: dict[str, Any], may: bool) -> None:
    assert who(rosproxy(), replace(pod(), **changes)) == ((pod().ip,) if may else ())


def test_a_pod_selector_counts() -> None:
    of = rosproxy(pod_selector=Selector({"app": "x"}))
    pods = pod("a", labels={"app": "x"}, ip="10.244.1.5"), pod("b", ip="10.244.1.6")
    assert who(of, *pods) == ("10.244.1.5",)


def test_a_pod_that_others_select_too_may_have_been_wired_before() -> None:
    assert who(rosproxy(), rosproxy("arm"), pod()) == (pod().ip,)


def test_all_addresses_of_a_pod_count() -> None:
    obj = pod_obj(labels={names.INJECT: "true"})
    obj["status"]["podIPs"] = [{"ip": "10.244.1.5"}, {"ip": "fd00::5"}]
    parsed = objects.pod(obj)
    assert parsed.ips == ("10.244.1.5", "fd00::5")
    local = replace(parsed, id=Name("ros", "talker"), node="one")
    assert who(rosproxy(), local) == ("10.244.1.5", "fd00::5")


@pytest.mark.parametrize("of", [(), (rosproxy(uid="other"),), (rosproxy(deleting=True),)])
def test_without_its_rosproxy_a_proxy_goes_on_with_what_it_knows(of: tuple[Any, ...]) -> None:
    assert who(*of, node(), pod()) is None
