"""Mistakes of administrators: the doctor names each mistake, and the doctor's fix works.

A fix is followed with the images of the tests: the command of a user takes the chart's images.
"""

import os
import subprocess
from collections.abc import Callable, Iterator

import pytest

from tests.docker.engine import wait_until
from tests.kubernetes import api, release
from tests.kubernetes.api import Json
from tests.kubernetes.cluster.control_plane import kubectl
from tests.kubernetes.cluster.layout import KUBECONFIG
from tests.kubernetes.mistakes import errors
from tests.kubernetes.pods import Namespace
from tests.kubernetes.robot import Robot
from tests.kubernetes.rosproxies import RosProxy, rosproxy
from tests.kubernetes.test_doctor import PROGRAM, doctor
from tests.kubernetes.traffic import wait_for_service


@pytest.fixture(autouse=True)
def _release_afterwards() -> Iterator[None]:
    yield
    release.upgrade()
    release.wait_operator()


@pytest.fixture
def made(net: Namespace, robot: Robot) -> RosProxy:
    """A RosProxy with a pod. All is well."""
    created = rosproxy(net.name, master={"uri": robot.master_uri}, ports=4)
    wait_for_service(net)
    net.idle(on="node1")
    created.the_proxy("node1", seconds=60)
    wait_content(net)
    return created


def wait_content(net: Namespace) -> None:
    wait_until(lambda: not errors(net.name), 90, lambda: f"content: {errors(net.name)}")


def first_error(net: Namespace, is_it: Callable[[Json], bool]) -> Json:
    """Wait until the first finding of the doctor is this error. Return the finding."""
    found: list[Json] = []

    def is_first() -> bool:
        found[:] = doctor(net.name)[1]
        return bool(found) and found[0]["severity"] == "error" and is_it(found[0])

    wait_until(is_first, 60, lambda: str(found))
    return found[0]


def test_no_operator_is_the_first_error(net: Namespace, made: RosProxy) -> None:
    deployment = f"deployment/{release.FULL_NAME}"
    kubectl("-n", release.NAMESPACE, "scale", deployment, "--replicas=0")
    found = first_error(net, lambda f: "no operator runs in the cluster" in f["text"])
    assert "helm upgrade --install rosproxy charts/rosproxy-operator" in found["fix"]
    release.upgrade()
    release.wait_operator()
    wait_content(net)
    assert made.proxies


def test_a_namespace_that_no_operator_manages(net: Namespace, made: RosProxy) -> None:
    release.upgrade(namespaces=["default"])
    release.wait_operator()
    found = first_error(net, lambda f: f"manages the namespace {net.name}" in f["text"])
    assert "of the operator: default)" in found["text"]
    assert "add the namespace to the chart's value namespaces and run helm upgrade" in found["fix"]
    release.upgrade(namespaces=["default", net.name])
    release.wait_operator()
    made.change(ports=6)
    wait_content(net)


def test_an_operator_that_may_write_no_status(net: Namespace, made: RosProxy) -> None:
    role = f"{release.FULL_NAME}-write"
    rules = api.get("clusterroles", "", role)["rules"]
    others = [rule for rule in rules if rule["resources"] != ["rosproxies/status"]]
    assert len(others) == len(rules) - 1
    api.patch("clusterroles", "", role, {"rules": others})
    made.change(ports=6)
    found = first_error(net, lambda f: f["subject"] == f"rosproxy {net.name}/robot")
    assert found["text"] == (
        "the operator lacks the right to patch rosproxies/status in this namespace"
    )
    assert "install the operator's chart or manifests again" in found["fix"]
    release.upgrade()
    wait_content(net)


def test_no_definition_of_rosproxies(net: Namespace) -> None:
    kubectl("delete", "crd", "rosproxies.rosproxy.io")
    ended = subprocess.run(
        [PROGRAM, "kubernetes", "--namespace", net.name, "doctor"],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
        env={**os.environ, "KUBECONFIG": str(KUBECONFIG)},
    )
    assert ended.returncode == 1
    assert ended.stderr.startswith(
        "rosproxy-operator: the CustomResourceDefinition rosproxies.rosproxy.io is not installed. "
        "Install the chart rosproxy-operator"
    )
    release.upgrade()
    release.wait_operator()
    wait_content(net)
