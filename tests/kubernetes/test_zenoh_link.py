"""``spec.link`` links pods of rmw_zenoh to another site, with the certificate of a Secret."""

import base64
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tests.certificates import CA, CERTIFICATE, KEY, Authority
from tests.docker.engine import docker, inspect
from tests.docker.images import PROXY, ZENOH, build_image
from tests.docker.zenoh import NODE, Cloud, Node
from tests.kubernetes import api
from tests.kubernetes.api import Json
from tests.kubernetes.cluster.images import load_images
from tests.kubernetes.cluster.network import plug_in_robot, unplug_robot
from tests.kubernetes.names import cluster_dns
from tests.kubernetes.pods import Namespace, namespace, unique
from tests.kubernetes.rosproxies import RosProxy, rosproxy
from tests.kubernetes.traffic import wait_for_service

NAME = "rosproxy-cluster-cloud"
ADDRESS = "10.88.0.53"
CABLE = "rpxcloud"
START = 120
"""Seconds that nodes get to start and to find each other, all at once."""
RENEWED = 180
"""Seconds in which the kubelet shows a changed Secret (its syncFrequency is a minute)."""
GOT = "got hello "


@pytest.fixture(scope="module")
def authority() -> Authority:
    return Authority()


@pytest.fixture(scope="module")
def cloud(
    authority: Authority, _release: None, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Cloud]:
    """A machine outside of the cluster with a proxy, and the image of the nodes in the cluster."""
    load_images(build_image(ZENOH))
    there = authority.write(tmp_path_factory.mktemp("cloud") / "cloud", ADDRESS)
    docker("rm", "--force", NAME, check=False)
    docker("run", "--detach", "--init", "--network", "none", "--name", NAME,
           *Cloud.options(there), PROXY, "sleep", "infinity")  # fmt: skip
    process = str(inspect(NAME)["State"]["Pid"])
    plug_in_robot(process, ADDRESS, CABLE)
    made = Cloud(partial(docker, "exec", "--detach", NAME), Path(f"/proc/{process}/root"))
    try:
        made.start_proxy()
        with cluster_dns():
            yield made
    finally:
        docker("rm", "--force", NAME, check=False)
        unplug_robot(CABLE)


@pytest.fixture
def net(cloud: Cloud) -> Iterator[Namespace]:
    without_host_ports = {"pod-security.kubernetes.io/enforce": "baseline"}
    with namespace(labels=without_host_ports) as net:
        yield net


def secret(namespace: str, folder: Path) -> Json:
    """A Secret with the files of a folder."""
    data = {
        name: base64.b64encode((folder / name).read_bytes()).decode()
        for name in (CERTIFICATE, KEY, CA)
    }
    meta = {"name": "link", "namespace": namespace}
    return {"apiVersion": "v1", "kind": "Secret", "metadata": meta, "data": data,
            "type": "kubernetes.io/tls"}  # fmt: skip


def node(net: Namespace, kind: str, topic: str, on: str, **more: Any) -> Node:
    name = unique(kind)
    pod = net.pod(*NODE, kind, name, topic, name=name, on=on, image=ZENOH, **more)
    return Node(name, pod.log)


def uids(of: RosProxy) -> set[str]:
    return {proxy.uid_then for proxy in of.proxies}


def test_pods_of_two_nodes_are_linked_to_another_site(
    net: Namespace, cloud: Cloud, authority: Authority, tmp_path: Path
) -> None:
    api.create(secret(net.name, authority.write(tmp_path / "first")))
    link = {"to": [f"tls/{ADDRESS}"], "secretName": "link"}
    of = rosproxy(net.name, ros="zenoh", link=link)
    wait_for_service(net)
    in_cloud = cloud.node("listener", "sub", "chatter")
    cloud.node("talker", "pub", "map")
    node(net, "pub", "chatter", "node1")
    backs = [node(net, "sub", "map", on) for on in ("node1", "node2")]
    for receiver in (in_cloud, *backs):
        receiver.wait_for(GOT, 5, START)
    of.wait_for("SitesReachable", "True", seconds=60)
    assert {of.on(name)["links"] for name in ("node1", "node2")} == {"1/1"}
    before = uids(of)

    # A certificate of another CA ends the link, and the right one brings it back.
    bad = Authority("another CA").write(tmp_path / "bad")
    (bad / CA).write_bytes(authority.pem)
    api.patch("secrets", net.name, "link", {"data": secret(net.name, bad)["data"]})
    condition = of.wait_for("SitesReachable", "False", "SiteUnreachable", RENEWED)
    assert "refuses the certificate of this proxy" in condition["message"]
    of.wait_event("SiteUnreachable", f"tls/{ADDRESS}:7447")
    good = authority.write(tmp_path / "good")
    api.patch("secrets", net.name, "link", {"data": secret(net.name, good)["data"]})
    of.wait_for("SitesReachable", "True", seconds=RENEWED)
    in_cloud.wait_for(GOT, 5, START)
    assert uids(of) == before, "a new certificate recreates no proxy"


def test_a_missing_secret_is_told_and_may_come_later(
    net: Namespace, cloud: Cloud, authority: Authority, tmp_path: Path
) -> None:
    link = {"to": [f"tls/{ADDRESS}"], "secretName": "link"}
    of = rosproxy(net.name, ros="zenoh", link=link)
    wait_for_service(net)
    talker = node(net, "pub", "late", "node1")
    near = node(net, "sub", "late", "node1")
    far = cloud.node("late", "sub", "late")
    near.wait_for(GOT, 5, START)
    condition = of.wait_for("Degraded", "True", "LinkCertificate", START)
    assert "zenoh file /etc/rosproxy/link/tls.crt: can't be read" in condition["message"]
    assert not far.has(GOT)
    assert not talker.has("Traceback")
    api.create(secret(net.name, authority.write(tmp_path / "late")))
    far.wait_for(GOT, 5, RENEWED)
    of.wait_for("SitesReachable", "True", seconds=60)
