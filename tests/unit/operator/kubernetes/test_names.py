"""Names of objects: stable, unique, and short enough."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy_operator.kubernetes.resources import names
from rosproxy_operator.kubernetes.resources.model import Name

LABEL = st.from_regex(r"[a-z0-9]([-a-z0-9]{0,44}[a-z0-9])?", fullmatch=True)
SUBDOMAIN = st.lists(LABEL, min_size=1, max_size=5).map(".".join)


def proxy_name(of: str, node: str) -> str:
    return names.proxy_id(Name("ros", of), node).name


def test_a_proxys_name_says_whose_it_is_and_where() -> None:
    assert (
        proxy_name("robot", "worker-1.example.org") == "rosproxy-robot-worker-1-example-org-e6cda6"
    )


def test_nodes_whose_names_look_alike_have_proxies_of_different_names() -> None:
    assert proxy_name("robot", "a.b") != proxy_name("robot", "a-b")
    assert proxy_name("a-b", "c") != proxy_name("a", "b-c")


@given(LABEL, SUBDOMAIN)
def test_a_proxys_name_is_always_a_host_name(of: str, node: str) -> None:
    name = proxy_name(of, node)
    assert len(name) <= 63
    assert set(name) <= set("abcdefghijklmnopqrstuvwxyz0123456789-")
    assert name.startswith(f"rosproxy-{of}-")
    assert not name.endswith("-")


@given(LABEL)
def test_a_services_name_is_a_label(of: str) -> None:
    name = names.service_id(Name("ros", of)).name
    assert len(name) <= 63
    assert name == f"rosproxy-{of}"  # never that of a service such as db


def test_names_are_in_the_rosproxys_namespace() -> None:
    of = Name("ros", "robot")
    assert names.service_id(of) == Name("ros", "rosproxy-robot")
    assert names.proxy_id(of, "one").namespace == "ros"


def test_own_labels_are_recognized_and_selected() -> None:
    labels = names.own_labels("robot")
    assert names.is_own(labels)
    assert names.OWN_SELECTOR.endswith(
        "app.kubernetes.io/component in (ear,image-check,lan-relay,proxy)"
    )
    rest = labels.items() - {(names.PROXY_OF, "robot"), (names.COMPONENT_LABEL, "proxy")}
    assert all(f"{key}={value}" in names.OWN_SELECTOR for key, value in rest)


@pytest.mark.parametrize("missing", list(names.own_labels("robot")))
def test_half_the_labels_are_not_enough(missing: str) -> None:
    labels = names.own_labels("robot")
    del labels[missing]
    assert not names.is_own(labels)


@pytest.mark.parametrize(
    ("address", "uri"),
    [("10.96.0.1", "http://10.96.0.1:11311"), ("fd00::1", "http://[fd00::1]:11311")],
)
def test_what_pods_use_as_their_master(address: str, uri: str) -> None:
    assert names.master_uri(address) == uri


def test_the_lan_relay_of_an_operator_before_0_1_0_is_its_own() -> None:
    labels = {**names.own_labels("robot"), names.COMPONENT_LABEL: "ear"}
    assert names.is_own(labels)
    assert names.component(labels) == names.LAN_RELAY
    assert names.component(names.own_labels("robot")) == names.PROXY
