"""helm uninstall leaves nothing behind, or by default the RosProxies alone."""

from pathlib import Path

from tests.docker.engine import wait_until
from tests.kubernetes import api, release
from tests.kubernetes.cluster.control_plane import kubectl
from tests.kubernetes.pods import INJECT, Namespace
from tests.kubernetes.robot import Robot
from tests.kubernetes.rosproxies import NOWHERE, all_proxies, rosproxy
from tests.kubernetes.traffic import START, wait_for_service

NAMES = ("rosproxy", "rosproxy-operator")
"""Of what the chart makes and of what the operator makes."""
CLUSTER_WIDE = ("customresourcedefinitions", "clusterroles", "clusterrolebindings",
                "mutatingwebhookconfigurations")  # fmt: skip
NAMESPACED = ("pods", "services", "secrets", "serviceaccounts", "roles", "rolebindings",
              "deployments", "poddisruptionbudgets", "networkpolicies", "leases")  # fmt: skip


def left() -> list[str]:
    """Remainders of the release in the cluster, as resource and name."""
    leftovers = []
    for resource in CLUSTER_WIDE + NAMESPACED:
        for body in api.objects(resource):
            name = body["metadata"]["name"]
            own = body["metadata"].get("labels", {}).get("app.kubernetes.io/name") in NAMES
            if own or ("rosproxy" in name and body["metadata"].get("namespace") != "default"):
                leftovers.append(f"{resource} {body['metadata'].get('namespace', '')}/{name}")
    return leftovers


def test_nothing_is_left(net: Namespace, robot: Robot) -> None:
    made = rosproxy(net.name, master={"uri": robot.master_uri}, ports=4)
    wait_for_service(net)
    pod = net.node("rospy", "pub", "--topic", "/last", "--word", "inside", on="node1")
    robot.node("listener_last", "rospy", "sub", "--topic", "/last").wait_for(
        "inside", seconds=START
    )
    assert made.proxies

    release.uninstall()

    wait_until(lambda: not left(), 60, lambda: f"left: {left()}")
    assert not all_proxies()
    assert [body["metadata"]["name"] for body in net.pods(INJECT)] == [pod.name]
    assert "rosproxy.io" not in kubectl("api-resources", "-o", "name")


def test_a_release_from_a_registry(net: Namespace, tmp_path: Path) -> None:
    """The command of docs/releasing.md."""
    release.remove()
    release.install_from_a_registry(tmp_path)
    release.wait_operator()
    made = rosproxy(net.name, master=NOWHERE, ports=4)
    net.idle()
    wait_until(lambda: bool(made.proxies), 60, made.tell)
    made.remove()
    wait_until(lambda: not made.proxies and not made.service, 40, made.tell)
    release.uninstall()


def test_rosproxies_stay_until_their_definition_is_deleted(net: Namespace) -> None:
    """The promise of `crds.keep`, which is on by default."""
    release.install_again(crds={"keep": True})
    release.wait_operator()
    made = rosproxy(net.name, master=NOWHERE, ports=4)
    net.idle()
    wait_until(lambda: bool(made.proxies), 60, made.tell)
    (before,) = made.proxies

    release.uninstall()

    assert api.get("rosproxies", net.name, "robot")
    assert [proxy.name for proxy in made.proxies] == [before.name]

    wait_for_garbage_collector(net)
    kubectl("delete", "crd", "rosproxies.rosproxy.io")

    wait_until(lambda: not left(), 60, lambda: f"left: {left()}")


def wait_for_garbage_collector(net: Namespace) -> None:
    """Wait until the garbage collector of Kubernetes watches RosProxies.

    It looks for new definitions each 30 s. Of a definition that was deleted before, it never learns
    that the objects have ended. Only the garbage collector ends a deletion in the foreground.
    """
    rosproxy(net.name, "watched", master=NOWHERE, ports=4)
    how = ("--cascade=foreground", "--timeout=100s")
    kubectl("delete", "rosproxies", "watched", "-n", net.name, *how, seconds=110)
