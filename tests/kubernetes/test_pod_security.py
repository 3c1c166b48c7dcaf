"""Namespaces that enforce a Pod Security Standard."""

from collections.abc import Iterator

import pytest

from tests.docker.engine import wait_until
from tests.kubernetes import api, release
from tests.kubernetes.pods import Namespace, namespace
from tests.kubernetes.rosproxies import NOWHERE, rosproxy

ENFORCE = "pod-security.kubernetes.io/enforce"


@pytest.fixture
def baseline(_release: None) -> Iterator[Namespace]:
    with namespace(labels={ENFORCE: "baseline"}) as made:
        yield made


def test_operator_runs_where_restricted_is_enforced() -> None:
    labels = api.get("namespaces", "", release.NAMESPACE)["metadata"]["labels"]
    assert labels[ENFORCE] == "restricted"
    assert all(pod.ready for pod in release.operators())


def test_baseline_forbids_host_ports_and_it_is_said_what_to_do(baseline: Namespace) -> None:
    made = rosproxy(baseline.name, master=NOWHERE, ports=4)
    baseline.idle(on="node1")
    event = made.wait_event("ProxyNotAdmitted")
    message = made.wait_for("Ready", "False")["message"]
    for text in (event.message, message):
        assert "hostPort" in text, text
        assert ENFORCE in text, text
    assert made.proxies == []

    api.patch("namespaces", "", baseline.name, {"metadata": {"labels": {ENFORCE: "privileged"}}})
    wait_until(lambda: bool(made.proxies), 90, lambda: f"the remedy helps: {made.tell()}")


def test_restricted_forbids_the_kernel_plane_and_it_is_said_what_to_do(net: Namespace) -> None:
    """The pod, which is not so restricted itself, was there before."""
    net.idle(on="node1")
    api.patch("namespaces", "", net.name, {"metadata": {"labels": {ENFORCE: "restricted"}}})

    made = rosproxy(net.name, master=NOWHERE, ports=4, dataPlane="Kernel")

    event = made.wait_event("ProxyNotAdmitted")
    for text in (event.message, made.wait_for("Ready", "False")["message"]):
        assert "hostPort" in text, text
        assert "NET_ADMIN for spec.dataPlane: Kernel" in text, text
        assert f"kubectl label namespace {net.name} {ENFORCE}=privileged" in text, text
    assert made.proxies == []
