"""Bounds of RosProxies, in a real cluster."""

import shlex

from tests.docker.engine import wait_until
from tests.kubernetes import api
from tests.kubernetes.cluster.control_plane import kubectl
from tests.kubernetes.pods import Namespace, namespace
from tests.kubernetes.rosproxies import NOWHERE, RosProxy, rosproxy

PUBLISHED = 11303


def wait_proxy(made: RosProxy) -> None:
    wait_until(lambda: bool(made.proxies), 40, made.tell)


def test_an_image_that_is_not_allowed(net: Namespace) -> None:
    made = rosproxy(net.name, master=NOWHERE, ports=4, image="evil:1")
    net.idle(on="node1")
    for kind, status in (("Ready", "False"), ("Degraded", "True")):
        message = made.wait_for(kind, status, "NotAllowed")["message"]
        assert message.startswith("spec.image: the operator does not allow 'evil:1'")
        assert "allow.images" in message
    made.wait_event("NotAllowed", "spec.image")
    assert made.proxies == []
    made.change(image=None)
    wait_proxy(made)


def test_what_is_there_stays_when_too_much_is_asked_for(net: Namespace) -> None:
    made = rosproxy(net.name, master=NOWHERE, ports=4)
    net.idle(on="node1")
    wait_proxy(made)
    (before,) = made.proxies
    made.change(image="evil:1", ports=8)
    made.wait_for("Ready", "False", "NotAllowed")
    (after,) = made.proxies
    assert (after.uid, after.ports) == (before.uid, before.ports)
    assert "evil" not in str(after.body["spec"])


def test_another_namespaces_master_needs_its_consent(net: Namespace) -> None:
    """The condition has the command for a user that may change the Service."""
    with namespace() as other:
        api.create({
            "apiVersion": "v1", "kind": "Service",
            "metadata": {"name": "master", "namespace": other.name},
            "spec": {"selector": {"app": "master"}, "ports": [{"port": 11311}]},
        })  # fmt: skip
        service = {"name": "master", "namespace": other.name}
        made = rosproxy(net.name, ports=4, master={"service": service, "publish": PUBLISHED})
        net.idle(on="node1")
        message = made.wait_for("Ready", "False", "NotAllowed")["message"]
        assert made.proxies == []
        command = shlex.split(message.partition("to run ")[2])
        assert command[0] == "kubectl"
        assert command[-1] == f"rosproxy.io/allow-from={net.name}"
        kubectl(*command[1:])
        wait_proxy(made)
        (proxy,) = made.proxies
        assert proxy.environment["ROSPROXY_PUBLISH_MASTER"] == str(PUBLISHED)


def test_the_token_is_in_no_pod(net: Namespace) -> None:
    made = rosproxy(net.name, master=NOWHERE, ports=4)
    net.idle(on="node1")
    wait_proxy(made)
    (proxy,) = made.proxies
    assert "ROSPROXY_ADMIN_TOKEN" not in proxy.environment
    assert len(proxy.environment["ROSPROXY_ADMIN_TOKEN_HASH"]) == 64
